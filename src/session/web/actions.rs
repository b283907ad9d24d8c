//! Actions of administrators: each needs their password.

use actix_web::{HttpRequest, HttpResponse, web};
use serde::Deserialize;

use crate::session::config::Announcement;
use crate::session::state::AppState;
use crate::shared::http::routing::{POST, path};
use crate::shared::http::{body, refuse_action};

/// Adds the paths to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/announcement", POST, announcement));
}

/// The body of `/announcement`; without a text the announcement ends.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct AnnouncementRequest {
    #[serde(default)]
    text: String,
    #[serde(default)]
    until: Option<String>,
}

async fn announcement(request: HttpRequest, payload: web::Payload, server: web::Data<AppState>) -> HttpResponse {
    let peer = server.config.trusted_proxies.peer(&request);
    if let Some(refusal) = refuse_action(server.admin_auth.as_ref(), &request, peer) {
        return refusal;
    }
    let order = body::json(&request, payload, "{\"text\": TEXT, \"until\": TIME}").await;
    let AnnouncementRequest { text, until } = match order {
        Ok(order) => order,
        Err(refusal) => return refusal,
    };
    if text.trim().is_empty() {
        log::info!("client {peer}: ends the announcement");
        server.announcements.set(None);
        return HttpResponse::Ok().body("nothing is announced");
    }
    match Announcement::new(&text, until.as_deref()) {
        Ok(announcement) if announcement.is_over() => HttpResponse::BadRequest().body("Error: until is over already."),
        Ok(announcement) => {
            log::info!("client {peer}: makes an announcement");
            server.announcements.set(Some(announcement));
            HttpResponse::Ok().body("announced")
        }
        Err(wrong) => HttpResponse::BadRequest().body(format!("Error: {wrong}.")),
    }
}
