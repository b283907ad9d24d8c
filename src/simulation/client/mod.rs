//! A web client, and the session of its simulation from the request for it to its end.

mod arrival;
mod resume;
mod roster_feed;
mod session;
mod slot_link;
mod spare;
mod spare_keeper;
mod start;
mod web_client;

pub use session::Session;
pub use slot_link::SlotLink;
pub use spare_keeper::SpareKeeper;
pub use web_client::WebClient;
