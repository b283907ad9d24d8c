//! Configuration files: loading, errors, and the types of values.

mod api_token;
mod fleet_key;
pub mod keys;
mod loading;
mod secret;
mod value;

pub use api_token::{ApiToken, Permission, check_api_tokens};
pub use fleet_key::check_fleet_key;
pub use loading::{Configuration, LoadedConfig, load, require, schema};
pub use secret::Secret;
pub use value::{
    Expanded, ExpandedPath, Minutes, OneOrMany, OptionalWhole, Percent, Seconds, SecondsOrZero, Sentence, Share, Whole,
    expand, is_web_url,
};
