//! Responses with pages: their type, and headers that restrict them to what they need.

use actix_web::HttpResponse;
use actix_web::http::header;

/// The policy (`Content-Security-Policy`) of a page that loads only files of its own server, and no inline script or
/// style.
pub const OWN_FILES: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
    connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'";

/// The policy of a viewer: it also connects to any simulation server, and embeds pages of its own server.
pub const VIEWER: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
    connect-src 'self' http: https: ws: wss:; frame-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'";

/// The policy of a page that runs scripts of other servers, also WebAssembly, with their styles, images and data. Pages of
/// the same server embed it (`frame-ancestors`), and its own script loads nothing outside of a frame. It has a separate
/// origin (`sandbox`): its scripts can't use the password or the storage of the server's other pages.
pub const FOREIGN_SCRIPTS: &str = "default-src 'none'; script-src 'self' http: https: 'wasm-unsafe-eval'; \
    style-src 'self' http: https:; img-src 'self' data: blob: http: https:; \
    connect-src 'self' data: blob: http: https: ws: wss:; frame-ancestors 'self'; base-uri 'none'; form-action 'self'; \
    sandbox allow-scripts allow-modals allow-pointer-lock";

/// The CSS class of the color of a bar, for a value in percent.
pub fn heat(percent: &f64) -> &'static str {
    match *percent {
        ..70.0 => "cool",
        70.0..95.0 => "warm",
        _ => "hot",
    }
}

/// The length of a bar that shows this many percent, as text from `0.0` to `100.0`.
pub fn width(percent: &f64) -> String {
    format!("{:.1}", percent.clamp(0.0, 100.0))
}

/// Answers with a page and its policy.
pub fn html(page: Result<String, askama::Error>, policy: &str) -> HttpResponse {
    match page {
        Ok(page) => HttpResponse::Ok()
            .insert_header((header::CONTENT_SECURITY_POLICY, policy))
            .insert_header((header::REFERRER_POLICY, "no-referrer"))
            .insert_header(("Cross-Origin-Opener-Policy", "same-origin"))
            .content_type("text/html; charset=utf-8")
            .body(page),
        Err(error) => HttpResponse::InternalServerError().body(format!("Error: {error}.")),
    }
}
