//! How a web client gets the reason why no simulation server is chosen for it.

use actix_web::http::StatusCode;
use serde_json::json;

use crate::shared::domain::{Failure, Reason};
use crate::shared::text::client_text;

/// The sentence, safe to show.
pub fn sentence(failure: &Failure) -> String {
    client_text(&format!("Error: {}.", failure.message))
}

/// The text for programs on a WebSocket.
pub fn reason_text(reason: Reason) -> String {
    let content = json!({"code": reason, "blame": reason.blame(), "retry": reason.retry()});
    format!("reason: {content}")
}

/// The status of an answer to a request that named a world.
pub fn status(reason: Reason) -> StatusCode {
    match reason {
        Reason::InvalidWorld => StatusCode::BAD_REQUEST,
        Reason::RepositoryNotAllowed | Reason::RepositoryBlocked => StatusCode::FORBIDDEN,
        _ => StatusCode::SERVICE_UNAVAILABLE,
    }
}
