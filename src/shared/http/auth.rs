//! Who may see and do what is for administrators: browsers that are signed in (`sign_in`), programs that send the password
//! with any user name (HTTP basic authentication, RFC 7617), and programs with a token (`apiTokens`, RFC 6750).

use std::fmt;

use actix_web::http::{Method, header};
use actix_web::{HttpRequest, HttpResponse};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use subtle::ConstantTimeEq;

use super::cookie::{SignIn, Use, cookies};
use super::guesses::{Guesser, Guesses, TooMany};
use super::peer::{Peer, TrustedProxies};
use super::routing::retry_after;
use crate::shared::config::{ApiToken, Permission, Secret};
use crate::shared::domain::{FleetKey, ServerRun};
use crate::shared::run::seconds_since_1970;
use crate::shared::text::one_line;

/// Tells administrators from others.
#[derive(Debug)]
pub struct AdminAuth {
    pub(super) settings: AuthSettings,
    /// The name of the cookie. Servers of one host, whose browsers' cookies they share, have different ports.
    pub(super) cookie: String,
    guesses: Guesses,
}

/// What [`AdminAuth`] needs.
#[derive(Debug)]
pub struct AuthSettings {
    /// The key `adminPassword`.
    pub password: Option<Secret>,
    /// The key `apiTokens`.
    pub tokens: Vec<ApiToken>,
    /// Signs cookies: that of the fleet, or a random one.
    pub key: FleetKey,
    /// Whether the key is that of a fleet.
    pub has_fleet: bool,
    /// The run of a simulation server with that key, to which session servers lead signed-in browsers.
    pub server_run: Option<ServerRun>,
    /// The key `port`.
    pub port: u16,
    /// Whether browsers send the cookie over encrypted connections only.
    pub ssl: bool,
    /// Tell the addresses of clients.
    pub trusted_proxies: TrustedProxies,
    /// The header in which they name users.
    pub user_header: Option<String>,
    /// The page that follows a sign-in.
    pub home: &'static str,
}

/// Who sends a request that is for administrators. Its text is for the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Administrator {
    /// The name that a trusted proxy, the sign-in or the program has given, or that of the token.
    pub name: String,
    may: Permission,
    way: Way,
    peer: Peer,
}

/// How an administrator is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    SignIn,
    Password,
    Token,
}

/// Why a request is refused, as text for the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AuthError {
    /// Nobody can be an administrator here.
    #[error("Error: actions are off; adminPassword is not set.")]
    Off,
    /// The request has no sign-in, password or token that is valid.
    #[error("Error: a password is needed.")]
    Unknown {
        /// Whether a browser's page sends it, whose visitor signs in with a form and not in a box of the browser.
        is_page: bool,
    },
    /// The client has sent too many wrong passwords; this one was not compared.
    #[error("Error: too many wrong passwords from your address.")]
    TooMany,
    /// The token may only read.
    #[error("Error: this token may only read.")]
    ReadOnly,
    /// The request comes from a page of another site, to which the browser may have added its cookie (CSRF).
    #[error("Error: this request comes from a page of another site.")]
    OtherSite,
}

impl AdminAuth {
    /// Nobody has signed in.
    pub fn new(settings: AuthSettings) -> Self {
        Self {
            cookie: format!("webots-administrator-{}", settings.port),
            guesses: Guesses::new(),
            settings,
        }
    }

    /// Whether some things are for administrators only: there is a password or a token.
    pub fn is_on(&self) -> bool {
        self.settings.password.is_some() || !self.settings.tokens.is_empty()
    }

    /// The administrator who sends a request that changes nothing.
    ///
    /// # Errors
    /// Why the request is refused.
    pub fn reader(&self, request: &HttpRequest) -> Result<Administrator, AuthError> {
        if let Some(sign_in) = self.signed_in(request).filter(|one| one.holds(seconds_since_1970())) {
            return Ok(self.administrator(request, &sign_in.name, Way::SignIn, Permission::Act));
        }
        let is_of_fleet = self.settings.has_fleet && matches!(credentials(request), Some(Credentials::Token(_)));
        if !self.is_on() && !is_of_fleet {
            return Err(AuthError::Off);
        }
        let unknown = AuthError::Unknown {
            is_page: is_page(request),
        };
        match credentials(request).ok_or(unknown)? {
            Credentials::Token(token) => {
                if let Some(name) = self.reads_for(&token) {
                    return Ok(self.administrator(request, &name, Way::SignIn, Permission::Read));
                }
                let is_same = |one: &&ApiToken| one.token.reveal().as_bytes().ct_eq(token.as_bytes()).into();
                let found = self.settings.tokens.iter().find(is_same).ok_or(unknown)?;
                Ok(self.administrator(request, &found.name, Way::Token, found.may))
            }
            Credentials::Password(user, password) => {
                let program = self.guesses.program(request, self.peer(request), &user);
                self.judge(request, program, &password, unknown)?;
                Ok(self.administrator(request, &user, Way::Password, Permission::Act))
            }
        }
    }

    /// The administrator who sends a request that changes something.
    ///
    /// # Errors
    /// Why the request is refused.
    pub fn actor(&self, request: &HttpRequest) -> Result<Administrator, AuthError> {
        if is_cross_site(request) {
            return Err(AuthError::OtherSite);
        }
        self.owner(request)
    }

    /// The administrator who sends a request, and may change something.
    ///
    /// # Errors
    /// Why the request is refused.
    pub fn owner(&self, request: &HttpRequest) -> Result<Administrator, AuthError> {
        let reader = self.reader(request)?;
        match reader.may {
            Permission::Act => Ok(reader),
            Permission::Read => Err(AuthError::ReadOnly),
        }
    }

    /// The administrator who signs in with this name and password.
    pub(super) fn sign_in(&self, request: &HttpRequest, name: &str, password: &str) -> Result<SignIn, AuthError> {
        let before = self.signed_in(request);
        let who = match &before {
            Some(before) => Guesser::Browser(before.browser),
            None => self.guesses.program(request, self.peer(request), name),
        };
        self.judge(request, who, password, AuthError::Unknown { is_page: true })?;
        let browser = before.map_or_else(rand::random, |before| before.browser);
        let name = one_line(name).trim().to_owned();
        let administrator = self.administrator(request, &name, Way::Password, Permission::Act);
        log::info!("{administrator}: signs in");
        Ok(SignIn {
            name,
            browser,
            until: 0,
        })
    }

    /// The sign-in of the browser that sends a request; it may have ended.
    pub(super) fn signed_in(&self, request: &HttpRequest) -> Option<SignIn> {
        let read = |text| SignIn::read(text, &self.settings.key, self.in_cookie());
        cookies(request, &self.cookie).find_map(read)
    }

    /// What the text in a cookie is for.
    pub(super) fn in_cookie(&self) -> Use<'_> {
        Use::Cookie(self.settings.password.as_ref().map_or("", Secret::reveal))
    }

    /// The administrator for whom a session server of the fleet reads something here.
    fn reads_for(&self, token: &str) -> Option<String> {
        let read = || SignIn::read(token, &self.settings.key, Use::Reading);
        let reading = self.settings.has_fleet.then(read)??;
        reading.holds(seconds_since_1970()).then_some(reading.name)
    }

    /// The client of a request.
    pub fn peer(&self, request: &HttpRequest) -> Peer {
        self.settings.trusted_proxies.peer(request)
    }

    fn judge(&self, request: &HttpRequest, who: Guesser, given: &str, wrong: AuthError) -> Result<(), AuthError> {
        let Some(password) = &self.settings.password else {
            return Err(wrong);
        };
        let is_right = || given.as_bytes().ct_eq(password.reveal().as_bytes()).into();
        match self.guesses.judge(who, is_right) {
            Ok(true) => Ok(()),
            Ok(false) => {
                log::warn!("client {}: a wrong administrator password", self.peer(request));
                Err(wrong)
            }
            Err(TooMany) => Err(AuthError::TooMany),
        }
    }

    fn administrator(&self, request: &HttpRequest, name: &str, way: Way, may: Permission) -> Administrator {
        let settings = &self.settings;
        let header = settings.user_header.as_ref().filter(|_| way != Way::Token);
        let user = header.and_then(|header| settings.trusted_proxies.user(request, header));
        Administrator {
            name: one_line(user.as_deref().unwrap_or(name)),
            may,
            way,
            peer: self.peer(request),
        }
    }
}

impl fmt::Display for Administrator {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, way, peer, .. } = self;
        match way {
            Way::Token => write!(out, "client {peer}, token {name:?}"),
            Way::SignIn | Way::Password if name.is_empty() => write!(out, "client {peer}, administrator"),
            Way::SignIn | Way::Password => write!(out, "client {peer}, administrator {name:?}"),
        }
    }
}

/// What a request is signed with.
enum Credentials {
    /// A user name and a password.
    Password(String, String),
    Token(String),
}

fn credentials(request: &HttpRequest) -> Option<Credentials> {
    let value = request.headers().get(header::AUTHORIZATION)?.to_str().ok()?;
    let (scheme, credentials) = value.split_once(' ')?;
    let credentials = credentials.trim();
    if scheme.eq_ignore_ascii_case("bearer") {
        return Some(Credentials::Token(credentials.to_owned()));
    }
    if !scheme.eq_ignore_ascii_case("basic") {
        return None;
    }
    let text = String::from_utf8(BASE64_STANDARD.decode(credentials).ok()?).ok()?;
    let (user, password) = text.split_once(':')?;
    Some(Credentials::Password(user.to_owned(), password.to_owned()))
}

/// Whether a page of another site has sent a request. Browsers send the page's `Origin`; other programs send none.
pub(super) fn is_cross_site(request: &HttpRequest) -> bool {
    let header = |name| {
        request
            .headers()
            .get(name)
            .map(|value| value.to_str().unwrap_or_default())
    };
    let host = header(header::HOST).unwrap_or_default();
    header(header::ORIGIN).is_some_and(|origin| {
        let of_page = origin.split_once("://").map_or(origin, |(_, authority)| authority);
        !of_page.eq_ignore_ascii_case(host)
    })
}

/// Whether a page, or a browser that opens one, has sent a request.
fn is_page(request: &HttpRequest) -> bool {
    let headers = request.headers();
    let accept = headers.get(header::ACCEPT).and_then(|value| value.to_str().ok());
    let marks = ["sec-fetch-mode", "x-requested-with", "origin"];
    marks.iter().any(|mark| headers.contains_key(*mark)) || accept.is_some_and(|accept| accept.contains("text/html"))
}

/// Whether a browser opens a page, and may be led to another one.
pub(super) fn opens_page(request: &HttpRequest) -> bool {
    let accept = request.headers().get(header::ACCEPT);
    let accept = accept.and_then(|value| value.to_str().ok());
    request.method() == Method::GET && accept.is_some_and(|accept| accept.contains("text/html"))
}

impl actix_web::ResponseError for AuthError {
    fn error_response(&self) -> HttpResponse {
        let mut response = match self {
            Self::Off | Self::ReadOnly | Self::OtherSite => HttpResponse::Forbidden(),
            Self::Unknown { .. } => HttpResponse::Unauthorized(),
            Self::TooMany => HttpResponse::TooManyRequests(),
        };
        match self {
            // A browser does not know this scheme, and opens no box.
            Self::Unknown { is_page: true } => {
                response.insert_header((header::WWW_AUTHENTICATE, "Bearer realm=\"administrator\""));
            }
            Self::Unknown { is_page: false } => {
                response.insert_header((header::WWW_AUTHENTICATE, "Basic realm=\"administrator\""));
            }
            Self::TooMany => {
                response.insert_header(retry_after());
            }
            _ => {}
        }
        response.body(self.to_string())
    }
}

#[cfg(test)]
mod tests {
    use actix_web::test::TestRequest;

    use super::*;

    #[test]
    fn only_pages_of_the_same_site_change_something() {
        let request = || TestRequest::post().insert_header((header::HOST, "lab.org:2000"));
        assert!(!is_cross_site(&request().to_http_request()));
        for (origin, is_other) in [
            ("https://lab.org:2000", false),
            ("http://LAB.org:2000", false),
            ("https://lab.org", true),
            ("https://lab.org:2000.evil.example", true),
            ("null", true),
        ] {
            let request = request().insert_header((header::ORIGIN, origin)).to_http_request();
            assert_eq!(is_cross_site(&request), is_other, "{origin}");
        }
    }
}
