//! A visitor with a real browser: from the first click on the viewer page to the end of the simulation. With our rules, tests/deploy/guide.sh
//! does the same.

use std::path::{Path, PathBuf};
use std::process::Stdio;

use tokio::process::Command;

use super::fleet::Fleet;
use super::rules::Rules;
use crate::support::{http, until};

fn program(variable: &str, default: &str, how: &str) -> PathBuf {
    let program = std::env::var_os(variable).map_or_else(|| PathBuf::from(default), PathBuf::from);
    assert!(
        program.is_file(),
        "this test needs {}, which is missing: {how}, or let {variable} name another",
        program.display()
    );
    program
}

#[actix_rt::test]
async fn a_visitor_gets_a_simulation_with_the_documents_rules() {
    let rules = Rules::DocumentsMachine;
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = root.join("target/test-venv/bin/python");
    let python = program("FLEET_TEST_PYTHON", python.to_str().unwrap(), "tests/python.sh makes it");
    program("CHROMIUM", "/usr/bin/chromium", "apt install chromium");
    let fleet = Fleet::start(rules).await;
    let page = format!("https://{}{}", fleet.browser.host, rules.session_path(fleet.session.port, "/viewer"));
    let visit = Command::new(python)
        .arg(root.join("tests/browser/through_web_server.py"))
        .arg(page)
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .stdin(Stdio::null())
        .kill_on_drop(true)
        .output();
    let visit =
        actix_rt::time::timeout(6 * crate::support::SOON, visit).await.expect("the visit does not end").unwrap();
    assert!(
        visit.status.success(),
        "{}{}",
        String::from_utf8_lossy(&visit.stdout),
        String::from_utf8_lossy(&visit.stderr)
    );
    for (server, address) in [(&fleet.here, "127.0.0.1"), (&fleet.there, "127.0.0.2")] {
        let url = format!("http://{address}:{}/status", server.port);
        until("nothing of the simulation is left", async || {
            http::get(&url).await.json()["simulations"].as_array().unwrap().is_empty()
        })
        .await;
    }
}
