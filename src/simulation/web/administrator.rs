//! Who may see and do what is the administrator's.

use actix_web::{HttpRequest, HttpResponse};

use crate::shared::http::{AuthError, is_administrator};
use crate::simulation::state::AppState;

/// Refuses who has not sent the administrator's password, and everybody where there is none.
pub fn refuse_others(request: &HttpRequest, server: &AppState) -> Option<HttpResponse> {
    let Some(auth) = &server.admin_auth else {
        return Some(HttpResponse::Forbidden().body("Error: actions are off; adminPassword is not set."));
    };
    auth.check(request, server.config.trusted_proxies.peer(request)).err().map(AuthError::answer)
}

/// Whether a request may see the ports of simulations: a client that reaches one steers its simulation. No client needs them
/// if streams are relayed; administrators see them in any case. Another password may be meant for a web server in front.
pub fn may_see_ports(request: &HttpRequest, server: &AppState) -> Result<bool, AuthError> {
    match &server.admin_auth {
        None => Ok(server.config.ports_are_public()),
        auth => is_administrator(auth.as_ref(), request, server.config.trusted_proxies.peer(request)),
    }
}
