//! Configuration files: reading them, telling what is wrong in them, and the kinds of values that keys have.

mod error;
mod loading;
mod value;

pub use error::ConfigError;
pub use loading::{Configuration, Loaded, Unfit, differences, load};
pub use value::{
    ExpandedPath, Secret, folder, local_address, object, one_or_many, optional_object, optional_port, percent, seconds,
    threshold, whole,
};
