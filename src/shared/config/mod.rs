//! Configuration files: loading, errors, and the types of values.

pub mod keys;
mod loading;
mod secret;
mod value;

pub use loading::{Configuration, LoadedConfig, load, require};
pub use secret::Secret;
pub use value::{
    ExpandedPath, choice, expanded, folder, is_web_url, local_address, minutes_or_zero, object, one_or_many,
    optional_expanded, optional_object, optional_whole, percent, seconds, seconds_or_zero, whole,
};
