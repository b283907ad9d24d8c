//! `deploy/prometheus`, checked by promtool, and the metrics it names against those that the servers export.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use regex_lite::Regex;
use serde_json::Value;

use crate::simulation::readings;
use crate::support::program::{demo_server, session_server};
use crate::support::{http, until};

fn project(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn read(path: &str) -> String {
    std::fs::read_to_string(project(path)).unwrap()
}

/// Runs promtool, which must succeed.
fn promtool(arguments: &[&str], file: &Path) {
    needs!("promtool");
    let output = Command::new("promtool").args(arguments).arg(file).output().unwrap();
    assert!(
        output.status.success(),
        "promtool {arguments:?} {}: {output:?}",
        file.display()
    );
}

/// The queries of the dashboard.
fn queries() -> Vec<String> {
    let dashboard: Value = serde_json::from_str(&read("deploy/prometheus/dashboard.json")).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let targets = panels.iter().flat_map(|panel| panel["targets"].as_array().unwrap());
    targets
        .map(|target| target["expr"].as_str().unwrap().to_owned())
        .collect()
}

/// The servers' metrics that a text names.
fn named(text: &str) -> BTreeSet<String> {
    let metric = Regex::new("webots_(session|simulation|machine)_[a-z_]+").unwrap();
    metric.find_iter(text).map(|found| found.as_str().to_owned()).collect()
}

/// The metrics of a page `/metrics`.
fn exported(page: &str) -> BTreeSet<String> {
    let samples = page.lines().filter(|line| !line.starts_with('#'));
    samples
        .map(|line| line.split(['{', ' ']).next().unwrap().to_owned())
        .collect()
}

#[test]
fn alerts_pass_promtool_and_fire_for_unhealthy_fleets() {
    promtool(&["check", "rules"], &project("deploy/prometheus/alerts.yml"));
    promtool(&["check", "config"], &project("deploy/prometheus/prometheus.yml"));
    promtool(&["test", "rules"], &project("tests/deploy/alerts.yml"));
    let rule = |(number, query): (usize, &String)| format!("  - {{record: query_{number}, expr: '{query}'}}\n");
    let rules: String = queries().iter().enumerate().map(rule).collect();
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), format!("groups:\n- name: dashboard\n  rules:\n{rules}")).unwrap();
    promtool(&["check", "rules"], file.path());
}

#[actix_rt::test]
async fn alerts_dashboard_and_docs_name_exported_metrics() {
    let driver = readings::gpu_driver();
    let simulation = demo_server(1)
        .env("LD_LIBRARY_PATH", driver.path().to_str().unwrap())
        .start()
        .await;
    let session = session_server(&[simulation.address(), "dns+fleet.test:2000".to_owned()])
        .start()
        .await;
    let metrics = async |url: String| exported(&http::get(&url).await.text());
    let all = async || {
        let mut all = metrics(session.url("/metrics")).await;
        all.extend(metrics(simulation.url("/metrics")).await);
        all
    };
    until("the server is up, and its GPUs are read", async || {
        let all = all().await;
        all.contains("webots_session_server_load_percent") && all.contains("webots_machine_gpu_compute_percent")
    })
    .await;
    let all = all().await;
    for name in &all {
        assert!(name.starts_with("webots_"), "{name}");
    }
    for (what, text) in [
        ("the alerts", read("deploy/prometheus/alerts.yml")),
        ("the dashboard", queries().join("\n")),
    ] {
        let named = named(&text);
        let unknown: Vec<&String> = named.difference(&all).collect();
        assert!(
            named.len() > 5 && unknown.is_empty(),
            "{what}: {unknown:?} of {named:?}"
        );
    }
    let docs = read("docs/operations.md");
    // The documentation names a histogram instead of its three metrics.
    let parts = Regex::new("_(bucket|sum|count)$").unwrap();
    let all = all.iter().map(|name| parts.replace(name, "").into_owned()).collect();
    assert_eq!(named(&docs), all, "the docs on the left");
}
