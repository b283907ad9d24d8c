//! The interface to browsers and programs: routes, pages, `/status` and `/metrics`.

mod access;
mod actions;
mod metrics;
mod page_routes;
mod pages;
mod routes;
mod status;
mod stream_routes;
mod webots_viewer;

pub use routes::configure;
