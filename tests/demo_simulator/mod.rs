//! Runs the built demo simulator and talks to it as a simulation server and as viewers do.
//!
//! Each simulator listens on a loopback address of its own, so that tests can run side by side with fixed
//! ports. Whatever is waited for has a deadline; what a simulator printed is shown when its test fails.

mod life;
mod simulator;
mod viewer;
mod viewing;
mod worlds;
