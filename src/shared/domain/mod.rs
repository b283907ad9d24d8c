//! The terms that both servers share: addresses, loads, world URLs, repositories, a server's report. Pure.

mod address;
mod admission;
mod client_urls;
mod load;
mod project_url;
mod reason;
mod server_report;
mod url_prefix;

pub use address::{PublicAddress, complete_host};
pub use admission::AdmissionRules;
pub use client_urls::{ClientUrls, PublicUrl};
pub use load::Load;
pub use project_url::{ProjectUrl, ProjectUrlError, Reading};
pub use reason::{Blame, Failure, Reason, Retry};
pub use server_report::{Instances, ServerReport};
pub use url_prefix::UrlPrefix;
