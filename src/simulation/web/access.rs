//! Who visits a page, and may see what; and from which pages browsers may use simulations.

use actix_web::HttpRequest;
use actix_web::error::ErrorForbidden;
use actix_web::http::header;

use crate::shared::http::{AuthError, Origin};
use crate::simulation::config::SimulationConfig;
use crate::simulation::state::AppState;

/// Who has sent a request, as far as the password shows. Another password may be meant for a web server in front.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Visitor {
    /// No password is configured.
    Anybody,
    /// The request has no password, or another one.
    Stranger,
    /// The request has the password.
    Administrator,
}

impl Visitor {
    /// The sender of a request.
    ///
    /// # Errors
    /// When its address has sent too many passwords: the page must not pass for that of a stranger.
    pub fn of(request: &HttpRequest, server: &AppState) -> Result<Self, AuthError> {
        let Some(auth) = &server.admin_auth else { return Ok(Self::Anybody) };
        match auth.check(request, server.config.trusted_proxies.peer(request)) {
            Ok(()) => Ok(Self::Administrator),
            Err(AuthError::NoPassword) => Ok(Self::Stranger),
            Err(AuthError::TooMany) => Err(AuthError::TooMany),
        }
    }

    /// Whether the visitor may see the ports of simulations: a client that reaches one controls its simulation. If no
    /// password is configured and clients need the ports, all visitors see them, as on the original's page.
    pub fn sees_ports(self, config: &SimulationConfig) -> bool {
        match self {
            Self::Administrator => true,
            Self::Stranger => false,
            Self::Anybody => config.ports_are_public(),
        }
    }
}

/// A page of another origin may use visitors' browsers to start simulations, unless origins are listed.
///
/// # Errors
/// The response to the request of a page that may not.
pub fn check_origin(request: &HttpRequest, allowed: &[Origin]) -> actix_web::Result<()> {
    let Some(origin) = request.headers().get(header::ORIGIN) else { return Ok(()) };
    let origin = origin.to_str().unwrap_or_default();
    if allowed.is_empty() || allowed.iter().any(|one| one.0 == origin) {
        return Ok(());
    }
    Err(ErrorForbidden("Error: this page is not one of those that may start simulations here."))
}
