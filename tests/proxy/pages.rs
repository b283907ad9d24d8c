//! Pages with all that they load, and what live pages are told.

use futures_util::StreamExt;

use super::browser::Browser;
use super::fleet::{Fleet, IDLE};
use super::rules::Rules;
use crate::support::SOON;

/// What a page names in `src` and `href`, but for other pages.
fn loaded(html: &str) -> Vec<&str> {
    let names = html.split(" src=\"").chain(html.split(" href=\"")).skip(1).filter_map(|rest| rest.split('"').next());
    names.filter(|name| name.contains("assets/") && !name.contains('<')).collect()
}

async fn has_all_that_it_loads(browser: &Browser, path: &str) {
    let url = url::Url::parse(&format!("https://{}{path}", browser.host)).unwrap();
    let page = browser.ask(url.as_str(), &[]).await;
    assert_eq!(page.status, 200, "{path}");
    let html = page.text();
    assert!(!loaded(&html).is_empty(), "{path}: {html}");
    for name in loaded(&html) {
        let part = url.join(name).unwrap();
        assert_eq!(browser.ask(part.as_str(), &[]).await.status, 200, "{path} loads {name}");
    }
}

/// Events come at once and go on for longer than the web server waits for a word.
async fn is_told_what_happens(browser: &Browser, path: &str) {
    let mut events =
        browser.begin(&format!("https://{}{path}", browser.host), &[("Accept", "text/event-stream")]).await;
    assert_eq!(events.status(), 200, "{path}");
    let begun = std::time::Instant::now();
    while begun.elapsed() < IDLE * 3 / 2 {
        let event = actix_rt::time::timeout(SOON, events.next()).await.expect("nothing is told");
        event.unwrap_or_else(|| panic!("{path}: the end")).unwrap();
    }
}

pub async fn what_webots_sends_has_an_origin_of_its_own(fleet: &Fleet, rules: Rules) {
    let policy = async |path: String| {
        let url = format!("https://{}{path}", fleet.browser.host);
        let answer = fleet.browser.ask(&url, &[]).await;
        answer.header("content-security-policy").unwrap_or_default().to_owned()
    };
    for server in [&fleet.here, &fleet.there] {
        for path in ["page.html", "", "%2e/page.html"] {
            // Whatever answers there, also nobody.
            assert_eq!(policy(format!("/{}/{path}", server.port + 1)).await, "sandbox allow-scripts", "{path}");
        }
        let own = policy(format!("/{}/monitor", server.port)).await;
        assert!(own.starts_with("default-src 'none'") && !own.contains("sandbox"), "{own}");
    }
    let door = policy(rules.session_path(fleet.session.port, "/monitor")).await;
    assert!(door.starts_with("default-src 'none'") && !door.contains("sandbox"), "{door}");
}

/// Each page has all that it loads.
pub async fn pages_are_complete(fleet: &Fleet, rules: Rules) {
    for page in ["/monitor", "/viewer"] {
        has_all_that_it_loads(&fleet.browser, &rules.session_path(fleet.session.port, page)).await;
    }
    has_all_that_it_loads(&fleet.browser, &format!("/{}/monitor", fleet.here.port)).await;
}

/// Live pages are told what happens for longer than the web server waits for a word.
pub async fn pages_are_live(fleet: &Fleet, rules: Rules) {
    let (door, here) = (rules.session_path(fleet.session.port, "/events"), format!("/{}/events", fleet.here.port));
    futures_util::join!(is_told_what_happens(&fleet.browser, &here), is_told_what_happens(&fleet.browser, &door));
}
