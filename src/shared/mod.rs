//! What both servers stand on. Knows neither of them.

pub mod config;
pub mod domain;
pub mod http;
pub mod run;
pub mod text;
