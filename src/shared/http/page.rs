//! Responses with pages: their type, headers that restrict them to what they need, and a page that is rendered for all
//! its visitors.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::time::{Duration, Instant};

use actix_web::http::header::{self, EntityTag, IfNoneMatch};
use actix_web::web::Bytes;
use actix_web::{HttpMessage, HttpRequest, HttpResponse, HttpResponseBuilder};
use tokio::sync::Mutex;
use tokio::time::sleep_until;

use super::origin::Origin;

/// The policy (`Content-Security-Policy`) of a page that loads only files of its own server, and no inline script or
/// style.
pub const OWN_FILES: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
    connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'";

/// The policy of a viewer: it also connects to any simulation server, and embeds pages of its own server.
pub const VIEWER: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
    connect-src 'self' http: https: ws: wss:; frame-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'";

/// The policy of a page that runs scripts of other servers, with their styles, fonts, images and data. Webots' viewer
/// compiles WebAssembly, and functions from texts (`glm-js`), and shows robot windows in frames. Pages of the same server
/// embed it (`frame-ancestors`), and its own script loads nothing outside of a frame. It has a separate origin
/// (`sandbox`): its scripts can't use the password or the storage of the server's other pages.
pub const FOREIGN_SCRIPTS: &str = "default-src 'none'; script-src 'self' http: https: 'unsafe-eval'; \
    style-src 'self' http: https:; font-src 'self' data: http: https:; img-src 'self' data: blob: http: https:; \
    connect-src 'self' data: blob: http: https: ws: wss:; frame-src http: https:; frame-ancestors 'self'; \
    base-uri 'none'; form-action 'self'; sandbox allow-scripts allow-modals allow-pointer-lock";

/// A policy by which pages of these origins may also embed the page.
pub fn framed_by(policy: &str, origins: &[Origin]) -> String {
    let Some((before, after)) = policy.split_once("frame-ancestors ") else {
        return policy.to_owned();
    };
    let (own, rest) = after.split_once(';').unwrap_or((after, ""));
    let allowed = [own].into_iter().filter(|own| *own != "'none'" || origins.is_empty());
    let all: Vec<&str> = allowed.chain(origins.iter().map(|one| one.0.as_str())).collect();
    format!("{before}frame-ancestors {};{rest}", all.join(" "))
}

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
        Ok(page) => restricted(policy).body(page),
        Err(error) => HttpResponse::InternalServerError().body(format!("Error: {error}.")),
    }
}

fn restricted(policy: &str) -> HttpResponseBuilder {
    let mut response = HttpResponse::Ok();
    response
        .insert_header((header::CONTENT_SECURITY_POLICY, policy))
        // Other sites get none. With `no-referrer`, forms would be sent without the `Origin` of their page.
        .insert_header((header::REFERRER_POLICY, "same-origin"))
        .insert_header(("Cross-Origin-Opener-Policy", "same-origin"))
        .content_type("text/html; charset=utf-8");
    response
}

/// Interval between two renderings of a page. Requests in between wait and share the next one, so that no request gets what
/// has changed since, and requests in a row cost little.
const PERIOD: Duration = Duration::from_millis(100);

/// A page that all its visitors share.
#[derive(Default)]
pub struct SharedPage(Mutex<Option<Rendered>>);

/// A page as it was rendered last.
struct Rendered {
    /// When this began.
    at: Instant,
    html: Bytes,
    tag: EntityTag,
}

impl SharedPage {
    /// Answers with the page and its policy; with 304 if the client has it (`If-None-Match`). `render` is used unless the
    /// page was rendered for another request that was waiting, too.
    ///
    /// # Errors
    /// When it can't be rendered.
    pub async fn answer(
        &self,
        request: &HttpRequest,
        policy: &str,
        render: impl Future<Output = actix_web::Result<String>>,
    ) -> actix_web::Result<HttpResponse> {
        let asked = Instant::now();
        let mut last = self.0.lock().await;
        let rendered = match last.take() {
            Some(shared) if shared.at >= asked => shared,
            before => {
                let next = before.map(|before| before.at + PERIOD);
                sleep_until(next.unwrap_or(asked).into()).await;
                let at = Instant::now();
                Rendered::new(at, render.await?)
            }
        };
        let rendered = last.insert(rendered);
        let is_known = request.get_header::<IfNoneMatch>().is_some_and(|known| match known {
            IfNoneMatch::Any => true,
            IfNoneMatch::Items(tags) => tags.iter().any(|tag| tag.weak_eq(&rendered.tag)),
        });
        let mut response = if is_known {
            HttpResponse::NotModified()
        } else {
            restricted(policy)
        };
        response.insert_header(header::ETag(rendered.tag.clone()));
        // Browsers may keep it, and ask each time whether it has changed.
        response.insert_header((header::CACHE_CONTROL, "private, no-cache"));
        Ok(if is_known {
            response.finish()
        } else {
            response.body(rendered.html.clone())
        })
    }
}

impl Rendered {
    fn new(at: Instant, html: String) -> Self {
        let mut hasher = DefaultHasher::new();
        html.hash(&mut hasher);
        Self {
            at,
            tag: EntityTag::new_strong(format!("{:016x}", hasher.finish())),
            html: html.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_named_origins_may_embed_a_page() {
        let lab = [
            Origin("https://lab.org".to_owned()),
            Origin("https://school.org".to_owned()),
        ];
        let ancestors = |policy: &str, origins: &[Origin]| {
            let policy = framed_by(policy, origins);
            let directives: Vec<_> = policy
                .split("; ")
                .filter(|one| one.starts_with("frame-ancestors"))
                .collect();
            directives.join("|")
        };
        assert_eq!(framed_by(VIEWER, &[]), VIEWER);
        assert_eq!(framed_by(FOREIGN_SCRIPTS, &[]), FOREIGN_SCRIPTS);
        assert_eq!(
            ancestors(VIEWER, &lab),
            "frame-ancestors https://lab.org https://school.org"
        );
        assert_eq!(
            ancestors(FOREIGN_SCRIPTS, &lab),
            "frame-ancestors 'self' https://lab.org https://school.org"
        );
    }
}
