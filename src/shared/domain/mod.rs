//! The terms that both servers share: addresses, loads, world URLs, repositories, a server's report. Pure.

mod address;
mod admission;
mod client_urls;
mod fleet_key;
mod load;
mod pass;
mod project_url;
mod ready;
mod reason;
mod roster;
mod server_report;
mod slot_link;
mod url_prefix;

pub use address::{PublicAddress, complete_host};
pub use admission::{Admission, AdmissionRules};
pub use client_urls::{ClientUrls, PublicUrl};
pub use fleet_key::{FleetKey, Purpose, SIGNATURE};
pub use load::Load;
pub use pass::{Pass, ReservationId, ServerRun};
pub use project_url::{ProjectUrl, ProjectUrlError, Reading};
pub use ready::{KeepReady, ReadyCount, ReadyEntry, ReadyStatus, View};
pub use reason::{Blame, Failure, Reason, Retry};
pub use roster::{
    Follow, RosterUpdate, SimulationReport, Stage, StopOrder, Stopped, ToSessionServer, ToSimulationServer,
};
pub use server_report::{Instances, ServerReport};
pub use slot_link::{Hello, MAX_LINK_MESSAGE, Offer, Offers, PassedOver, Proof, Wish, Wishes};
pub use url_prefix::UrlPrefix;
