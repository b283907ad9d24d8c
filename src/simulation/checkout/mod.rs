//! A client's world, checked out with git: cached, fetched once for all clients of it, cancellable, with progress.
//!
//! For git's settings see [`git`].

mod checkout_service;
mod commit_resolver;
mod disk;
mod file_restore;
mod git;
mod http_trace;
mod overlap;
mod project;
mod redirect;
mod repository;
mod repository_cache;
mod revision;
mod single_flight;
mod steps;
mod work_tree;

pub use checkout_service::{CheckoutService, KeptRepository, Tips};
pub use disk::outgrown;
pub use project::Project;
pub use repository_cache::CacheDir;
pub use revision::Tip;
pub use single_flight::{SingleFlight, Steps};
