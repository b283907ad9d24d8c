//! What browsers and programs meet: paths, pages, `/status` and `/metrics`.

mod actions;
mod page_routes;
mod pages;
mod queries;
mod routes;
mod status;
mod webots_viewer;

pub use routes::configure;
