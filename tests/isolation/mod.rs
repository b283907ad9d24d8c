//! What a world's program may do at each level of isolation.

mod assets;
pub mod deeds;
mod display;
mod level;
mod limits;
mod lives;
mod loading;
pub mod network;
mod reserve;
mod resets;
