//! The session server: the one door to a fleet of simulation servers.

pub mod placement;
