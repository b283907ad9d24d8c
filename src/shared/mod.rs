//! The modules that both servers share. They depend on neither server.

pub mod config;
pub mod domain;
pub mod http;
pub mod run;
pub mod text;
