//! What the visitor of a page may see, and which origins may start simulations.

use actix_web::HttpRequest;
use actix_web::error::ErrorForbidden;
use actix_web::http::header;

use crate::shared::http::{AuthError, Origin};
use crate::simulation::config::SimulationConfig;
use crate::simulation::state::AppState;

/// The sender of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Visitor {
    /// No password or token is configured.
    Anybody,
    /// The request has no sign-in, or another password, which may be meant for a web server in front.
    Stranger,
    /// The request is an administrator's.
    Administrator,
}

impl Visitor {
    /// The sender of a request.
    ///
    /// # Errors
    /// When its address has sent too many passwords: the administrator must not get the page for strangers.
    pub fn of(request: &HttpRequest, server: &AppState) -> Result<Self, AuthError> {
        match server.admin_auth.reader(request) {
            Ok(_) => Ok(Self::Administrator),
            Err(AuthError::Off) => Ok(Self::Anybody),
            Err(AuthError::TooMany) => Err(AuthError::TooMany),
            Err(_) => Ok(Self::Stranger),
        }
    }

    /// Whether the visitor may see the ports of simulations: a client that can reach a port controls its simulation. If
    /// no password is configured and clients need the ports, all visitors see them, as on the original's page.
    pub fn sees_ports(self, config: &SimulationConfig) -> bool {
        match self {
            Self::Administrator => true,
            Self::Stranger => false,
            Self::Anybody => config.ports_are_public(),
        }
    }
}

/// Checks the origin of a page that uses a browser to start simulations. Without listed origins, all are allowed.
///
/// # Errors
/// The response to a page that may not.
pub fn check_origin(request: &HttpRequest, allowed: &[Origin]) -> actix_web::Result<()> {
    let Some(origin) = request.headers().get(header::ORIGIN) else {
        return Ok(());
    };
    let origin = origin.to_str().unwrap_or_default();
    if allowed.is_empty() || allowed.iter().any(|one| one.0 == origin) {
        return Ok(());
    }
    Err(ErrorForbidden(
        "Error: this page is not one of those that may start simulations here.",
    ))
}
