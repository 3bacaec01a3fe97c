//! Integration tests: golden data and real files.
