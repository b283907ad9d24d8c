//! Whether a request may see the ports of simulations.

use actix_web::HttpRequest;

use crate::shared::http::{AuthError, is_administrator};
use crate::simulation::state::AppState;

/// Whether a request may see the ports of simulations: a client that reaches one steers its simulation. No client needs them
/// if streams are relayed; administrators see them in any case. Another password may be meant for a web server in front.
pub fn may_see_ports(request: &HttpRequest, server: &AppState) -> Result<bool, AuthError> {
    match &server.admin_auth {
        None => Ok(server.config.ports_are_public()),
        auth => is_administrator(auth.as_ref(), request, server.config.trusted_proxies.peer(request)),
    }
}
