//! A client's world, checked out of git: cached, fetched once for all who want it, cancellable, with progress.
//!
//! To change how long a fetch may take, or how much it may bring, see [`limits`]; what git obeys, see [`git`].

mod cache;
mod cache_dir;
mod checkout;
mod copy;
mod disk;
mod error;
mod finder;
mod git;
mod git_error;
mod growth;
mod lfs;
mod limits;
mod mirrors;
mod project;
mod redirect;
mod repository;
mod restored;
mod revision;
mod search;
mod single_flight;
mod spellings;
mod steps;
mod world_file;

pub use cache_dir::CacheDir;
pub use checkout::{Checkouts, Progress};
pub use error::CheckoutError;
pub use limits::Limits;
pub use mirrors::Mirrors;
pub use project::Project;
pub use single_flight::SingleFlight;
