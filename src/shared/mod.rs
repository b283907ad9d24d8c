//! What both servers stand on. Knows neither of them.

pub mod address;
pub mod config;
pub mod load;
pub mod logging;
pub mod project_url;
pub mod repositories;
pub mod shutdown;
pub mod status;
