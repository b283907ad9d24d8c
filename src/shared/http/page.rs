//! Responses with pages: their type, and headers that restrict them to what they need.

use std::collections::BTreeSet;

use actix_web::HttpResponse;
use actix_web::http::header;

use crate::shared::domain::PublicAddress;

/// The policy (`Content-Security-Policy`) of a page that loads only files of its own server, and no inline script or
/// style.
pub const OWN_FILES: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
    connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'";

/// The policy of a viewer: it also connects to any simulation server, and embeds pages of its own server.
pub const VIEWER: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; \
    connect-src 'self' http: https: ws: wss:; frame-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'";

/// Largest number of hosts in a policy, so that it fits into a header.
const MOST_HOSTS: usize = 40;

/// The policy of a page that runs scripts of its own server and of these sources, also WebAssembly, with their styles, and
/// loads images and data from any host. Pages of the same server embed it (`frame-ancestors`). It has an origin of its
/// own (`sandbox`): its scripts can't use the password or the storage of the server's other pages.
pub fn foreign_scripts(sources: &[String]) -> String {
    let files = [&["'self'".to_owned()], sources].concat().join(" ");
    format!(
        "default-src 'none'; script-src {files} 'wasm-unsafe-eval'; style-src {files}; \
         img-src 'self' data: blob: http: https:; connect-src 'self' data: blob: http: https: ws: wss:; \
         frame-ancestors 'self'; base-uri 'none'; form-action 'self'; \
         sandbox allow-scripts allow-modals allow-pointer-lock"
    )
}

/// The sources of scripts that a fleet serves: its hosts, with any port where ports are not rewritten, since each
/// simulation has a port of its own. Any host, where one of them can't be named in a policy: it knows letters of ASCII
/// and no IPv6 addresses (CSP Level 3, section 2.3.1).
pub fn fleet_sources<'address>(addresses: impl Iterator<Item = &'address PublicAddress>, ssl: bool) -> Vec<String> {
    let hosts: BTreeSet<String> = addresses
        .map(|address| format!("{}{}", address.host(), if address.is_rewritten() { "" } else { ":*" }))
        .collect();
    let can_be_named = |host: &String| host.chars().all(|one| one.is_ascii_alphanumeric() || ".:*-".contains(one));
    if hosts.len() > MOST_HOSTS || !hosts.iter().all(can_be_named) {
        return vec![any_host(ssl)];
    }
    hosts.iter().map(|host| format!("{}//{host}", any_host(ssl))).collect()
}

/// The source of scripts of a fleet whose hosts are not known yet: any host.
pub fn any_host(ssl: bool) -> String {
    if ssl { "https:" } else { "http:" }.to_owned()
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
        Ok(page) => HttpResponse::Ok()
            .insert_header((header::CONTENT_SECURITY_POLICY, policy))
            .insert_header((header::REFERRER_POLICY, "no-referrer"))
            .insert_header(("Cross-Origin-Opener-Policy", "same-origin"))
            .content_type("text/html; charset=utf-8")
            .body(page),
        Err(error) => HttpResponse::InternalServerError().body(format!("Error: {error}.")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn addresses(texts: &[&str]) -> Vec<PublicAddress> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    #[test]
    fn a_fleet_is_named_by_its_hosts() {
        let sources = |texts: &[&str], ssl| fleet_sources(addresses(texts).iter(), ssl);
        assert_eq!(sources(&["a:1", "a:2"], false), ["http://a:*"]);
        assert_eq!(sources(&["b/2000", "a/2000"], true), ["https://a", "https://b"]);
        assert_eq!(sources(&["b:8443/2000"], true), ["https://b:8443"]);
        assert_eq!(sources(&["b\u{fc}ro.example:1"], true), ["https://xn--bro-hoa.example:*"]);
        assert_eq!(sources(&["a:1", "[::1]:2000"], false), ["http:"], "an IPv6 address can't be named");
        let many: Vec<String> = (0..50).map(|number| format!("h{number}:1")).collect();
        let many: Vec<&str> = many.iter().map(String::as_str).collect();
        assert_eq!(sources(&many, true), ["https:"], "too long to be named one by one");
    }
}
