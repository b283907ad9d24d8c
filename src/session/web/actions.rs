//! Actions of administrators: each needs their password.

use actix_web::{HttpRequest, HttpResponse, web};

use crate::session::config::{Announcement, AnnouncementKeys};
use crate::session::state::AppState;
use crate::shared::http::refuse_action;
use crate::shared::http::routing::{POST, json_body, path};

/// Adds the paths to an app.
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/announcement", POST, announcement));
}

/// Replaces the announcement; without a text it ends.
async fn announcement(request: HttpRequest, payload: web::Payload, server: web::Data<AppState>) -> HttpResponse {
    let peer = server.config.trusted_proxies.peer(&request);
    if let Some(refusal) = refuse_action(server.admin_auth.as_ref(), &request, peer) {
        return refusal;
    }
    let order = json_body(&request, payload, "{\"text\": TEXT, \"until\": TIME}").await;
    let order: AnnouncementKeys = match order {
        Ok(order) => order,
        Err(refusal) => return refusal,
    };
    if order.text.trim().is_empty() {
        log::info!("client {peer}: ends the announcement");
        server.announcements.set(None);
        return HttpResponse::Ok().body("nothing is announced");
    }
    match Announcement::try_from(order) {
        Ok(announcement) if announcement.is_over() => HttpResponse::BadRequest().body("Error: until is over already."),
        Ok(announcement) => {
            log::info!("client {peer}: makes an announcement");
            server.announcements.set(Some(announcement));
            HttpResponse::Ok().body("announced")
        }
        Err(wrong) => HttpResponse::BadRequest().body(format!("Error: {wrong}.")),
    }
}
