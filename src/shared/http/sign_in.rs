//! `/sign-in` and `/sign-out` of both servers: a form for the password, and the cookie that a browser gets for it.

use actix_web::http::{Method, StatusCode, header};
use actix_web::{HttpRequest, HttpResponse, web};
use askama::Template;
use url::form_urlencoded;

use super::auth::{AdminAuth, Administrator, AuthError, is_cross_site, opens_page};
use super::cookie::{SignIn, Use};
use super::page::{OWN_FILES, html};
use super::routing::{POST, body, path};
use crate::shared::domain::ServerRun;
use crate::shared::run::seconds_since_1970;

/// How long a sign-in holds, in seconds.
const VALIDITY: u64 = 8 * 3600;
/// How long an entry to another server of the fleet, or a token to read there, holds, in seconds.
const ENTRY: u64 = 60;
/// How long a browser keeps the cookie, in seconds: by it, the browser is known after the end of its sign-in.
const KEPT: u64 = 365 * 24 * 3600;

/// The page with the form.
#[derive(Template)]
#[template(path = "sign_in.html")]
struct Form<'one> {
    /// The page that follows.
    to: &'one str,
    /// Why the last attempt has failed.
    problem: &'one str,
}

/// The page that leads a browser on, once it has its cookie: a redirect from another site would not send that.
#[derive(Template)]
#[template(path = "entered.html")]
struct Entered<'one> {
    to: &'one str,
}

/// Adds the routes to an app, whose data has an [`AdminAuth`].
pub fn configure(app: &mut web::ServiceConfig) {
    app.service(path("/sign-in", &[Method::GET, Method::POST], sign_in))
        .service(path("/sign-out", POST, sign_out));
}

/// Answers a request that no administrator has sent: with the form, if a browser opens a page, which is `to`.
pub fn refuse(error: AuthError, request: &HttpRequest, to: &str) -> HttpResponse {
    if opens_page(request) && matches!(error, AuthError::Unknown { .. }) {
        let query: String = form_urlencoded::Serializer::new(String::new())
            .append_pair("to", to)
            .finish();
        return lead(&format!("sign-in?{query}"));
    }
    HttpResponse::from_error(error)
}

/// The query of a URL that leads the browser of an administrator to a page of this simulation server, without signing in
/// there.
pub fn entry(auth: &AdminAuth, administrator: Administrator, server: ServerRun, to: &str) -> String {
    let entry = signed(auth, administrator, Use::Entry(server));
    form_urlencoded::Serializer::new(String::new())
        .append_pair("entry", &entry)
        .append_pair("to", to)
        .finish()
}

/// A token to read something from other servers for an administrator. All of them see it, also one without the key of the
/// fleet, so it signs no browser in.
pub fn reading_token(auth: &AdminAuth, administrator: Administrator) -> String {
    signed(auth, administrator, Use::Reading)
}

fn signed(auth: &AdminAuth, Administrator { name, .. }: Administrator, purpose: Use) -> String {
    let sign_in = SignIn {
        name,
        browser: rand::random(),
        until: seconds_since_1970() + ENTRY,
    };
    sign_in.write(&auth.settings.key, purpose)
}

async fn sign_in(request: HttpRequest, payload: web::Payload, auth: web::Data<AdminAuth>) -> HttpResponse {
    if request.method() == Method::POST {
        return check_form(&request, payload, &auth).await;
    }
    let (mut to, mut entry) = (String::new(), None);
    for (name, value) in form_urlencoded::parse(request.query_string().as_bytes()) {
        match &*name {
            "to" => to = value.into_owned(),
            "entry" => entry = Some(value),
            _ => {}
        }
    }
    let to = destination(&to, &auth);
    if let Some((entry, server)) = entry.zip(auth.settings.server_run) {
        return enter(&auth, &entry, server, to);
    }
    match auth.reader(&request) {
        Ok(_) => lead(to),
        Err(error @ AuthError::Unknown { .. }) => form(to, "", error, &request),
        Err(error) => HttpResponse::from_error(error),
    }
}

/// The form; with 401 if the request has credentials that are wrong.
fn form(to: &str, problem: &str, error: AuthError, request: &HttpRequest) -> HttpResponse {
    let is_wrong = !problem.is_empty() || request.headers().contains_key(header::AUTHORIZATION);
    let mut response = html(Form { to, problem }.render(), OWN_FILES);
    if is_wrong {
        *response.status_mut() = HttpResponse::from_error(error).status();
    }
    response
}

async fn check_form(request: &HttpRequest, payload: web::Payload, auth: &AdminAuth) -> HttpResponse {
    if is_cross_site(request) {
        return HttpResponse::from_error(AuthError::OtherSite);
    }
    if auth.settings.password.is_none() {
        return HttpResponse::from_error(AuthError::Off);
    }
    let body = match body(request, payload).await {
        Ok(body) => body,
        Err(refusal) => return refusal,
    };
    let mut fields = [
        ("name", String::new()),
        ("password", String::new()),
        ("to", String::new()),
    ];
    for (name, value) in form_urlencoded::parse(&body) {
        if let Some((_, field)) = fields.iter_mut().find(|(one, _)| *one == name) {
            *field = value.into_owned();
        }
    }
    let [(_, name), (_, password), (_, to)] = fields;
    let to = destination(&to, auth);
    match auth.sign_in(request, &name, &password) {
        Ok(sign_in) => {
            let sign_in = SignIn {
                until: seconds_since_1970() + VALIDITY,
                ..sign_in
            };
            with_cookie(lead(to), auth, &sign_in)
        }
        Err(error @ AuthError::TooMany) => form(
            to,
            "Too many wrong passwords from your address. Wait a minute.",
            error,
            request,
        ),
        Err(error) => form(to, "This is not the password.", error, request),
    }
}

/// Signs a browser in that a session server of the fleet has led here.
fn enter(auth: &AdminAuth, entry: &str, server: ServerRun, to: &str) -> HttpResponse {
    let now = seconds_since_1970();
    let read = SignIn::read(entry, &auth.settings.key, Use::Entry(server));
    let Some(entry) = read.filter(|entry| entry.holds(now)) else {
        return lead("sign-in");
    };
    let sign_in = SignIn {
        until: now + VALIDITY,
        ..entry
    };
    with_cookie(html(Entered { to }.render(), OWN_FILES), auth, &sign_in)
}

/// Ends the sign-in of a browser, which stays known to the limit of guesses.
async fn sign_out(request: HttpRequest, auth: web::Data<AdminAuth>) -> HttpResponse {
    if is_cross_site(&request) {
        return HttpResponse::from_error(AuthError::OtherSite);
    }
    let response = lead("monitor");
    match auth.signed_in(&request) {
        Some(sign_in) => with_cookie(response, &auth, &SignIn { until: 0, ..sign_in }),
        None => response,
    }
}

/// Leads a browser to a page of this server.
fn lead(to: &str) -> HttpResponse {
    HttpResponse::build(StatusCode::SEE_OTHER)
        .insert_header((header::LOCATION, to))
        .finish()
}

/// Without a path, the cookie is for the folder of this page: what a web server in front has for other programs does not
/// get it.
fn with_cookie(mut response: HttpResponse, auth: &AdminAuth, sign_in: &SignIn) -> HttpResponse {
    let value = sign_in.write(&auth.settings.key, auth.in_cookie());
    let secure = if auth.settings.ssl { "; Secure" } else { "" };
    let cookie = format!(
        "{}={value}; Max-Age={KEPT}; HttpOnly; SameSite=Strict{secure}",
        auth.cookie
    );
    if let Ok(cookie) = header::HeaderValue::try_from(cookie) {
        response.headers_mut().append(header::SET_COOKIE, cookie);
    }
    response
}

/// The page that follows a sign-in: one of this server's, never another site.
fn destination<'one>(to: &'one str, auth: &AdminAuth) -> &'one str {
    let (page, id) = to.split_once("?id=").unwrap_or((to, ""));
    let is_page = !page.is_empty() && page.bytes().all(|letter| letter.is_ascii_lowercase());
    let is_id = id
        .bytes()
        .all(|letter| letter.is_ascii_digit() || letter == b'T' || letter == b'-');
    if is_page && is_id { to } else { auth.settings.home }
}
