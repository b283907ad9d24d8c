//! Who visits a page, and may see what.

use actix_web::HttpRequest;

use crate::shared::http::AuthError;
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
