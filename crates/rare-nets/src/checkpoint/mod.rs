//! Weight files, read without executing anything.
