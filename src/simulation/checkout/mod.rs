//! A client's world, checked out of git: cached, fetched once for all who want it, cancellable, with progress.

mod cache_lock;
mod cached_repository;
mod checkout;
mod download;
mod errand;
mod error;
mod examined;
mod fetcher;
mod git;
mod housekeeping;
mod lfs;
mod limits;
mod mirrors;
mod quarantine;
mod repository_cache;
mod revision;
mod single_flight;
mod world_file;

pub use checkout::{Checkouts, Progress, Project};
pub use error::CheckoutError;
pub use fetcher::Fetcher;
pub use git::Git;
pub use limits::Limits;
pub use mirrors::Mirrors;
pub use repository_cache::RepositoryCache;
