//! Responses with pages: their type, and headers that restrict them to what they need.

use actix_web::http::header;
use actix_web::{HttpRequest, HttpResponse};

use crate::shared::domain::PublicAddress;

/// What a page may load and connect to: the value of `Content-Security-Policy`.
#[derive(Debug)]
pub struct ContentSecurityPolicy(String);

/// Largest number of hosts in a policy, so that it fits into a header.
const MOST_HOSTS: usize = 40;

impl ContentSecurityPolicy {
    /// A page that loads only files of its own server, and no inline script or style.
    pub fn own() -> Self {
        Self::new(&[], "", &[], ["'none'", "'none'"], "")
    }

    /// A viewer: it also connects to these sources, and embeds pages of its own server (`frame-src`). It may open
    /// WebSockets to that server, which for older browsers `'self'` does not include. The host comes from `Host` only:
    /// any client can set `X-Forwarded-Host` and `Forwarded`.
    pub fn viewer(request: &HttpRequest, sources: &[String]) -> Self {
        let own = own_sources(request).into_iter().filter(|source| source.starts_with("ws"));
        let connections: Vec<String> = own.chain(sources.iter().cloned()).collect();
        Self::new(&[], "", &connections, ["'self'", "'none'"], "")
    }

    /// A page that runs scripts of these sources, also WebAssembly, with their styles and images, and loads images and
    /// data that a world refers to, from any host. Pages of the same server embed it (`frame-ancestors`). It has an origin
    /// of its own (`sandbox`): its scripts can't use the password or the storage of the server's other pages.
    pub fn foreign(sources: &[String]) -> Self {
        let sandbox = "; sandbox allow-scripts allow-modals allow-pointer-lock";
        Self::new(sources, " data: blob: https:", sources, ["'none'", "'self'"], sandbox)
    }

    fn new(run: &[String], data: &str, connect: &[String], [frames, ancestors]: [&str; 2], sandbox: &str) -> Self {
        let own = |sources: Vec<&str>| [vec!["'self'"], sources].concat().join(" ");
        let files = own(run.iter().map(String::as_str).filter(|source| !source.starts_with("ws")).collect());
        let wasm = if sandbox.is_empty() { "" } else { " 'wasm-unsafe-eval'" };
        let connect = own(connect.iter().map(String::as_str).collect());
        Self(format!(
            "default-src 'none'; script-src {files}{wasm}; style-src {files}; img-src {files}{data}; \
             connect-src {connect}{data}; frame-src {frames}; frame-ancestors {ancestors}; base-uri 'none'; \
             form-action 'self'{sandbox}"
        ))
    }
}

/// The server that a request was sent to, by each scheme. Nothing where its name can't stand in a policy.
pub fn own_sources(request: &HttpRequest) -> Vec<String> {
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    if host.is_empty() || !host.chars().all(|one| one.is_ascii_alphanumeric() || ".:-".contains(one)) {
        return Vec::new();
    }
    ["ws", "wss", "http", "https"].map(|scheme| format!("{scheme}://{host}")).to_vec()
}

/// The sources from which a fleet is reached: its hosts, with any port where ports are not rewritten, since each
/// simulation has a port of its own. Any host, where one of them can't be named in a policy: it knows letters of ASCII
/// and no IPv6 addresses (CSP Level 3, section 2.3.1).
pub fn fleet_sources<'address>(addresses: impl Iterator<Item = &'address PublicAddress>, ssl: bool) -> Vec<String> {
    let mut hosts: Vec<String> = addresses
        .map(|address| format!("{}{}", address.host(), if address.is_rewritten() { "" } else { ":*" }))
        .collect();
    hosts.sort_unstable();
    hosts.dedup();
    let can_be_named = |host: &String| host.chars().all(|one| one.is_ascii_alphanumeric() || ".:*-".contains(one));
    if hosts.len() > MOST_HOSTS || !hosts.iter().all(can_be_named) {
        return any_host(ssl);
    }
    let (http, websocket) = schemes(ssl);
    hosts.iter().flat_map(|host| [format!("{http}://{host}"), format!("{websocket}://{host}")]).collect()
}

/// The sources of a fleet whose hosts are not known yet: any host.
pub fn any_host(ssl: bool) -> Vec<String> {
    let (http, websocket) = schemes(ssl);
    vec![format!("{http}:"), format!("{websocket}:")]
}

fn schemes(ssl: bool) -> (&'static str, &'static str) {
    if ssl { ("https", "wss") } else { ("http", "ws") }
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

/// Answers with a page.
pub fn html(page: Result<String, askama::Error>, policy: &ContentSecurityPolicy) -> HttpResponse {
    match page {
        Ok(page) => HttpResponse::Ok()
            .insert_header((header::CONTENT_SECURITY_POLICY, policy.0.as_str()))
            .insert_header((header::X_CONTENT_TYPE_OPTIONS, "nosniff"))
            .insert_header((header::REFERRER_POLICY, "no-referrer"))
            .insert_header(("Cross-Origin-Opener-Policy", "same-origin"))
            .content_type("text/html; charset=utf-8")
            .body(page),
        Err(error) => HttpResponse::InternalServerError().body(format!("Error: {error}.")),
    }
}

#[cfg(test)]
mod tests {
    use actix_web::test::TestRequest;

    use super::*;

    fn addresses(texts: &[&str]) -> Vec<PublicAddress> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    #[test]
    fn a_fleet_is_named_by_its_hosts() {
        let sources = |texts: &[&str], ssl| fleet_sources(addresses(texts).iter(), ssl);
        assert_eq!(sources(&["a:1", "a:2"], false), ["http://a:*", "ws://a:*"]);
        assert_eq!(sources(&["b/2000", "a/2000"], true), ["https://a", "wss://a", "https://b", "wss://b"]);
        assert_eq!(sources(&["b:8443/2000"], true), ["https://b:8443", "wss://b:8443"]);
        assert_eq!(
            sources(&["b\u{fc}ro.example:1"], true),
            ["https://xn--bro-hoa.example:*", "wss://xn--bro-hoa.example:*"]
        );
        assert_eq!(sources(&["a:1", "[::1]:2000"], false), ["http:", "ws:"], "an IPv6 address can't be named");
        let many: Vec<String> = (0..50).map(|number| format!("h{number}:1")).collect();
        let many: Vec<&str> = many.iter().map(String::as_str).collect();
        assert_eq!(sources(&many, true), ["https:", "wss:"], "too long to be named one by one");
    }

    #[test]
    fn a_page_reaches_the_host_that_it_was_asked_from() {
        let policy = |headers: &[(&'static str, &'static str)]| {
            let request = TestRequest::default();
            let request = headers.iter().fold(request, |request, header| request.insert_header(*header));
            ContentSecurityPolicy::viewer(&request.to_http_request(), &[]).0
        };
        assert!(
            policy(&[("host", "a.example:8443")])
                .contains("connect-src 'self' ws://a.example:8443 wss://a.example:8443;")
        );
        assert!(policy(&[("host", "a.example; img-src *")]).contains("connect-src 'self';"));
        let forged = [("x-forwarded-host", "evil.example"), ("forwarded", "host=evil.example")];
        for forged in forged {
            assert!(!policy(&[("host", "a.example"), forged]).contains("evil.example"), "{forged:?}");
            assert!(!policy(&[forged]).contains("evil.example"), "{forged:?}");
        }
    }
}
