//! Who is an administrator: by the form and its cookie, by the password, by a token; and how guesses are limited.

use std::collections::BTreeMap;

use awc::http::StatusCode;
use futures_util::StreamExt;
use serde_json::{Value, json};

use crate::support::http::PASSWORD;
use crate::support::program::{Builder, Server, demo_server, session_server};
use crate::support::until;

const TOKEN: &str = "0123456789abcdef0123456789abcdef";
const READER: &str = "fedcba9876543210fedcba9876543210";
const KEY: &str = "a key for a whole fleet";

/// Both servers.
fn servers() -> [Builder; 2] {
    [session_server(&[]), demo_server(1)]
}

/// What a server changes for an administrator: the path, and the status if it does.
fn action(server: &Server) -> (String, u16) {
    if server.log().contains("session server") {
        (server.url("/announcement"), 200)
    } else {
        (server.url("/simulations/1-1/stop"), 404)
    }
}

/// The page that follows a sign-in.
fn home(server: &Server) -> &'static str {
    if server.log().contains("session server") {
        "class"
    } else {
        "monitor"
    }
}

async fn send(url: &str, headers: &[(&str, &str)], body: &str) -> StatusCode {
    let request = headers
        .iter()
        .fold(awc::Client::default().post(url), |request, header| {
            request.append_header(*header)
        });
    request.send_body(body.to_owned()).await.unwrap().status()
}

async fn act(server: &Server, headers: &[(&str, &str)]) -> u16 {
    let (url, done) = action(server);
    let status = send(&url, headers, "").await.as_u16();
    if status == done { 200 } else { status }
}

/// Sends the form. Returns the status, where it leads, and the value of the cookie that the browser has then.
async fn sign_in(server: &Server, form: &str, cookie: Option<&str>) -> (u16, String, Option<String>) {
    let mut request = awc::Client::builder()
        .disable_redirects()
        .finish()
        .post(server.url("/sign-in"));
    if let Some(cookie) = cookie {
        request = request.insert_header(("Cookie", named(server, cookie)));
    }
    let request = request.insert_header(("Content-Type", "application/x-www-form-urlencoded"));
    let answer = request.send_body(form.to_owned()).await.unwrap();
    let text = |name| {
        answer
            .headers()
            .get(name)
            .map(|value| value.to_str().unwrap().to_owned())
    };
    (
        answer.status().as_u16(),
        text("location").unwrap_or_default(),
        text("set-cookie").map(|set| value(server, &set)),
    )
}

async fn signed_in(server: &Server) -> String {
    let (status, to, cookie) = sign_in(server, "name=Anna&password=open+sesame", None).await;
    assert_eq!((status, to.as_str()), (303, home(server)));
    cookie.unwrap()
}

fn port(server: &Server) -> String {
    server.address().rsplit(':').next().unwrap().to_owned()
}

/// The value of a cookie that a browser may use as it should.
fn value(server: &Server, set: &str) -> String {
    let (pair, rest) = set.split_once("; ").unwrap();
    assert_eq!(rest, "Max-Age=31536000; HttpOnly; SameSite=Strict");
    let (name, value) = pair.split_once('=').unwrap();
    assert_eq!(name, format!("webots-administrator-{}", port(server)));
    value.to_owned()
}

/// A cookie with this value, as if this server had sent it.
fn named(server: &Server, value: &str) -> String {
    format!("other=1; webots-administrator-{}={value}", port(server))
}

async fn with_cookie(server: &Server, value: &str) -> u16 {
    act(server, &[("Cookie", &named(server, value))]).await
}

fn basic(user: &str, password: &str) -> String {
    use base64::Engine;
    format!(
        "Basic {}",
        base64::prelude::BASE64_STANDARD.encode(format!("{user}:{password}"))
    )
}

#[actix_rt::test]
async fn a_form_signs_in_until_sign_out() {
    for builder in servers() {
        let server = builder.set("adminPassword", PASSWORD).start().await;
        assert_eq!(with_cookie(&server, "x").await, 401);
        assert_eq!(
            sign_in(&server, "password=guess", None).await,
            (401, String::new(), None)
        );
        assert_eq!(sign_in(&server, "", None).await.0, 401);
        let cookie = signed_in(&server).await;
        assert_eq!(with_cookie(&server, &cookie).await, 200);
        until("the log names who acts", async || {
            server.log().contains("administrator \"Anna\": signs in")
        })
        .await;
        // Another site's page, for which a browser might send the cookie.
        let header = named(&server, &cookie);
        let foreign = [("Cookie", header.as_str()), ("Origin", "https://evil.example")];
        assert_eq!(act(&server, &foreign).await, 403);
        for path in ["/sign-in", "/sign-out"] {
            assert_eq!(send(&server.url(path), &foreign, "").await, 403, "{path}");
        }
        let changed = format!("A{}", &cookie[1..]);
        assert!(changed == cookie || with_cookie(&server, &changed).await == 401);
        let out = awc::Client::builder()
            .disable_redirects()
            .finish()
            .post(server.url("/sign-out"));
        let out = out.insert_header(("Cookie", header)).send().await.unwrap();
        let ended = value(&server, out.headers().get("set-cookie").unwrap().to_str().unwrap());
        assert_eq!(with_cookie(&server, &ended).await, 401);
        // The page that follows is one of this server.
        for (to, expected) in [
            ("watch?id=2026-1", "watch?id=2026-1"),
            ("//evil.example", home(&server)),
            ("https://evil.example", home(&server)),
            ("/\\evil.example", home(&server)),
            ("watch?id=1&x=2", home(&server)),
        ] {
            let to = to.replace('&', "%26");
            let (status, location, _) = sign_in(&server, &format!("password=open+sesame&to={to}"), None).await;
            assert_eq!((status, location.as_str()), (303, expected), "{to}");
        }
    }
}

#[actix_rt::test]
async fn a_cookie_is_for_one_password_and_one_fleet() {
    for (of_first, of_second) in servers().into_iter().zip(servers().into_iter().rev()) {
        let first = of_first
            .set("adminPassword", PASSWORD)
            .set("fleetKey", KEY)
            .start()
            .await;
        let cookie = signed_in(&first).await;
        let folder = tempfile::tempdir().unwrap();
        let other = |key: Option<&str>, password: &str| {
            let builder = session_server(&[]).folder(folder.path()).set("adminPassword", password);
            match key {
                Some(key) => builder.set("fleetKey", key),
                None => builder,
            }
        };
        for (key, password, expected) in [
            (Some(KEY), PASSWORD, 200),
            (Some("another key for a fleet"), PASSWORD, 401),
            (None, PASSWORD, 401),
            (Some(KEY), "open barley", 401),
        ] {
            let server = other(key, password).start().await;
            assert_eq!(with_cookie(&server, &cookie).await, expected, "{key:?} {password}");
        }
        // Without a key, a cookie ends with the server.
        let alone = of_second.set("adminPassword", PASSWORD).start().await;
        let cookie = signed_in(&alone).await;
        assert_eq!(with_cookie(&alone, &cookie).await, 200);
        assert_eq!(with_cookie(&other(None, PASSWORD).start().await, &cookie).await, 401);
        if home(&alone) == "monitor" {
            // It goes on in the process that takes over.
            let (succeeds, told) = alone.upgrade().await;
            assert!(succeeds, "{told}");
            assert_eq!(with_cookie(&alone, &cookie).await, 200);
        }
    }
}

#[actix_rt::test]
async fn only_wrong_passwords_count_and_lock_nobody_out_who_is_known() {
    let tokens = json!([{"name": "backup", "token": TOKEN, "may": "act"}]);
    for builder in servers() {
        let server = builder
            .set("adminPassword", PASSWORD)
            .set("apiTokens", tokens.clone())
            .start()
            .await;
        let cookie = signed_in(&server).await;
        // Known from now on.
        assert_eq!(
            act(&server, &[("Authorization", &basic("teacher", PASSWORD))]).await,
            200
        );
        let (right, wrong) = (basic("teacher", PASSWORD), basic("student", "guess"));
        let mut guesses: BTreeMap<u16, usize> = BTreeMap::new();
        let begin = std::time::Instant::now();
        for number in 0..400 {
            assert_eq!(act(&server, &[("Authorization", &right)]).await, 200, "{number}");
            *guesses
                .entry(act(&server, &[("Authorization", &wrong)]).await)
                .or_default() += 1;
            if number % 4 == 0 {
                let token = format!("Bearer {TOKEN}");
                assert_eq!(act(&server, &[("Authorization", &token)]).await, 200, "{number}");
                assert_eq!(with_cookie(&server, &cookie).await, 200, "{number}");
            }
        }
        let minutes = begin.elapsed().as_secs_f64() / 60.0;
        #[expect(clippy::cast_precision_loss, reason = "a few hundred")]
        let compared = guesses[&401] as f64;
        assert!(
            compared >= 30.0 && compared <= 31.0 + 12.0 * minutes,
            "{guesses:?} in {minutes} min"
        );
        assert_eq!(guesses.keys().copied().collect::<Vec<_>>(), [401, 429]);
        // Over the limit, the form refuses strangers, and knows the browser of the administrator.
        assert_eq!(sign_in(&server, "name=student&password=open+sesame", None).await.0, 429);
        assert_eq!(
            sign_in(&server, "name=Anna&password=open+sesame", Some(&cookie))
                .await
                .0,
            303
        );
    }
}

#[actix_rt::test]
async fn a_token_does_what_it_may() {
    let tokens = json!([
        {"name": "backup", "token": TOKEN, "may": "act"},
        {"name": "board", "token": READER, "may": "read"},
    ]);
    for builder in servers() {
        let server = builder.set("apiTokens", tokens.clone()).start().await;
        for (token, expected) in [(TOKEN, 200), (READER, 403), ("guess", 401), ("", 401)] {
            let header = format!("Bearer {token}");
            assert_eq!(act(&server, &[("Authorization", &header)]).await, expected, "{token}");
        }
        assert_eq!(act(&server, &[("Authorization", &basic("admin", TOKEN))]).await, 401);
        assert_eq!(sign_in(&server, &format!("password={TOKEN}"), None).await.0, 403);
    }
}

#[actix_rt::test]
async fn a_token_that_can_be_guessed_is_refused() {
    let token = |token: &str| json!({"name": "x", "token": token, "may": "act"});
    for (tokens, expected) in [
        (json!([token("short")]), "openssl rand -hex 32"),
        (json!([token(&"ab".repeat(20))]), "openssl rand -hex 32"),
        (json!([token(&format!("{TOKEN} {TOKEN}"))]), "openssl rand -hex 32"),
        (json!([token(TOKEN), token(READER)]), "two tokens have the name"),
        (json!([{"name": "", "token": TOKEN, "may": "act"}]), "is no name"),
        (json!([{"name": "x", "token": TOKEN, "may": "all"}]), "all"),
        (json!([{"name": "x", "token": TOKEN}]), "may"),
    ] as [(Value, &str); 7]
    {
        for builder in servers() {
            let said = builder.set("apiTokens", tokens.clone()).refused(2).await;
            assert!(
                said.contains("apiTokens") && said.contains(expected),
                "{tokens}: {said}"
            );
            assert!(!said.contains(TOKEN) && !said.contains("abab"), "{said}");
        }
    }
}

#[actix_rt::test]
async fn a_browser_opens_no_box_of_its_own() {
    let server = demo_server(1).set("adminPassword", PASSWORD).start().await;
    let url = server.url("/watch?id=2026-1");
    let get = async |headers: &[(&str, &str)]| {
        let client = awc::Client::builder().disable_redirects().finish();
        let request = headers
            .iter()
            .fold(client.get(&url), |request, header| request.insert_header(*header));
        let answer = request.send().await.unwrap();
        let text = |name| {
            answer
                .headers()
                .get(name)
                .map(|value| value.to_str().unwrap().to_owned())
        };
        (answer.status().as_u16(), text("location"), text("www-authenticate"))
    };
    let (status, to, _) = get(&[("Accept", "text/html,*/*;q=0.8")]).await;
    assert_eq!((status, to.as_deref()), (303, Some("sign-in?to=watch%3Fid%3D2026-1")));
    let (status, _, scheme) = get(&[]).await;
    assert_eq!(
        (status, scheme.as_deref()),
        (401, Some("Basic realm=\"administrator\""))
    );
    let (status, _, scheme) = get(&[("X-Requested-With", "page")]).await;
    assert_eq!(
        (status, scheme.as_deref()),
        (401, Some("Bearer realm=\"administrator\""))
    );
    // The form needs no script.
    let pages = futures_util::stream::iter(["/sign-in", "/sign-in?to=%22%3E%3Cscript%3Ex%3C/script%3E"]);
    let pages: Vec<String> = pages
        .then(async |path| crate::support::http::get(&server.url(path)).await.text())
        .collect()
        .await;
    for page in pages {
        assert!(
            page.contains("type=\"password\"") && !page.contains("<script>"),
            "{page}"
        );
    }
}
