//! The terms that both servers speak in: addresses, loads, world URLs, repositories, a server's report. Pure.

mod address;
mod admission;
mod client_urls;
mod load;
mod project_url;
mod report;
mod repositories;

pub use address::{PublicAddress, check_host};
pub use admission::Rules;
pub use client_urls::{ClientUrls, PublicUrl};
pub use load::Load;
pub use project_url::{NoProject, ProjectUrl, Reading, RefKind};
pub use report::{Instances, ServerReport};
pub use repositories::UrlPrefix;
