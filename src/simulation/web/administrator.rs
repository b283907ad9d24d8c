//! Who may see and do what is the administrator's.

use actix_web::http::header;
use actix_web::{HttpRequest, HttpResponse};

use crate::shared::http::AuthError;
use crate::simulation::state::AppState;

/// Refuses who has not sent the administrator's password, and everybody where there is none.
pub fn refuse_others(request: &HttpRequest, server: &AppState) -> Option<HttpResponse> {
    let Some(auth) = &server.admin_auth else {
        return Some(HttpResponse::Forbidden().body("Error: actions are off; adminPassword is not set."));
    };
    auth.check(request, server.config.trusted_proxies.peer(request)).err().map(AuthError::answer)
}

/// Whether who asks may see the ports of simulations: who reaches one steers its simulation. Nobody needs them where the
/// streams are relayed, and who has the password sees them in any case.
pub fn may_see_ports(request: &HttpRequest, server: &AppState) -> Result<bool, AuthError> {
    match &server.admin_auth {
        Some(auth) if request.headers().contains_key(header::AUTHORIZATION) => {
            auth.check(request, server.config.trusted_proxies.peer(request)).map(|()| true)
        }
        _ => Ok(server.admin_auth.is_none() && server.config.ports_are_public()),
    }
}
