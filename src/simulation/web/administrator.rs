//! Who visits a page, and may see what.

use actix_web::HttpRequest;

use crate::shared::http::{AuthError, is_administrator};
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
    /// When its address has sent too many passwords.
    pub fn of(request: &HttpRequest, server: &AppState) -> Result<Self, AuthError> {
        let peer = server.config.trusted_proxies.peer(request);
        Ok(match &server.admin_auth {
            None => Self::Anybody,
            auth if is_administrator(auth.as_ref(), request, peer)? => Self::Administrator,
            Some(_) => Self::Stranger,
        })
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
