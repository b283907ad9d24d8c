//! A fleet for interactive robot simulations in the browser.

pub mod session;
pub mod shared;
pub mod simulation;
