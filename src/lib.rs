//! Session server and simulation server for interactive Webots simulations in the browser.

pub mod session;
