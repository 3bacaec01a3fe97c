//! The program as its users see it: files in, files, exit codes and messages out.

mod bad_input;
mod commands;
mod options;
mod outputs;
mod registration;
mod shared;
