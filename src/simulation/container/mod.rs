//! Simulations in containers of Docker, a compose project for each.

mod containers;
mod docker;
mod dockerfile;
mod image;
mod objects;
mod prepared;
mod recipe;
mod request;
mod template;

pub use containers::Containers;
pub use objects::{Owner, sweep};
pub use prepared::Prepared;
pub use request::Request;
