//! Configuration files: loading, errors, and the types of values.

pub mod keys;
mod loading;
mod secret;
mod value;

pub use loading::{Configuration, LoadedConfig, load, require};
pub use secret::{Secret, check_fleet_key};
pub use value::{
    ExpandedPath, expand, expanded, is_web_url, minutes, one_or_many, optional_whole, percent, seconds,
    seconds_or_zero, whole,
};
