//! What `server.sh` refuses; a refusal changes nothing.

use std::net::TcpListener;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::copy::{Outcome, Project, nothing_is_left};
use crate::support::{http, until};

/// Runs `server.sh`, which must fail with this exit code; returns its error output.
async fn refused(project: &Project, arguments: &[&str], code: i32) -> String {
    let Outcome {
        code: found,
        output,
        errors,
    } = project.server_sh(arguments).await;
    assert_eq!(found, Some(code), "{arguments:?}: {output}{errors}");
    errors
}

#[actix_rt::test]
async fn a_name_that_is_not_configured_is_refused_with_those_that_are() {
    let project = Project::copy();
    for action in ["start", "stop", "restart", "status"] {
        for name in ["nowhere", "../session/demo", "de mo", "-demo", ""] {
            let told = refused(&project, &[action, name], 2).await;
            assert!(
                told.contains("there is neither config/simulation/") && told.contains("demo\nlocal"),
                "{told}"
            );
        }
    }
    assert!(refused(&project, &["begin"], 2).await.contains("usage:"));
    assert!(refused(&project, &[], 2).await.contains("usage:"));
    nothing_is_left(&project).await;
}

#[actix_rt::test]
async fn what_runs_already_is_not_started_twice() {
    let project = Project::copy();
    let (one, other) = futures_util::join!(
        project.server_sh(&["start", "demo"]),
        project.server_sh(&["start", "demo"])
    );
    let (lost, won) = if one.code == Some(0) {
        (other, one)
    } else {
        (one, other)
    };
    assert_eq!((won.code, lost.code), (Some(0), Some(1)), "{won:#?} {lost:#?}");
    assert!(lost.errors.contains("already runs"), "{lost:#?}");
    // The other configuration has the same ports.
    let told = refused(&project, &["start", "local"], 1).await;
    assert!(
        told.contains("in use") && told.contains("this runs already: demo"),
        "{told}"
    );
    // Only the missing server is started.
    let alive = project.pid("simulation", "demo");
    kill(Pid::from_raw(project.pid("session", "demo")), Signal::SIGKILL).unwrap();
    let is_gone = async || {
        project
            .server_sh(&["status", "demo"])
            .await
            .output
            .contains("the session server does not run")
    };
    until("it is gone", is_gone).await;
    let told = project.done(&["start", "demo"]).await;
    assert!(
        told.contains(&format!("the simulation server of demo already runs (process {alive})")),
        "{told}"
    );
    assert_eq!(http::get(&project.session_url("/health")).await.text(), "ok");
}

#[actix_rt::test]
async fn a_server_that_does_not_start_shows_its_last_words() {
    let project = Project::copy();
    for port in [project.simulation, project.session] {
        let _listener = TcpListener::bind(("127.0.0.1", port)).unwrap();
        let told = refused(&project, &["start", "demo"], 1).await;
        assert!(
            told.contains(&format!("can't listen on 127.0.0.1:{port}: Address already in use")),
            "{told}"
        );
    }
    nothing_is_left(&project).await;
    project.configure("session/demo", |config| config["logDir"] = "server.sh".into());
    let told = refused(&project, &["start", "demo"], 1).await;
    assert!(
        told.contains("the session server of demo has not started") && told.contains("can't be written"),
        "{told}"
    );
    nothing_is_left(&project).await;
}

#[actix_rt::test]
async fn a_wrong_configuration_is_refused_and_stops_nothing() {
    needs!("bwrap");
    let project = Project::copy();
    project.done(&["start", "demo"]).await;
    project.configure("simulation/demo", |config| config["maxConnections"] = "many".into());
    for action in ["restart", "start"] {
        let told = refused(&project, &[action, "demo"], 2).await;
        assert_eq!(told.lines().count(), 1, "{told}");
        assert!(
            told.starts_with("error: config/simulation/demo.json: maxConnections: "),
            "{told}"
        );
    }
    assert_eq!(http::get(&project.session_url("/health")).await.text(), "ok");
    project.done(&["stop"]).await;
    nothing_is_left(&project).await;
}

#[actix_rt::test]
async fn a_stale_pid_file_does_no_harm() {
    needs!("bwrap");
    let project = Project::copy();
    let file = project.path("log/simulation/demo.pid");
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    // The first is the id of this test process, as if it had been reused.
    for text in [
        format!("{}\n", std::process::id()),
        "4194304\n".to_owned(),
        "nonsense".to_owned(),
        String::new(),
    ] {
        std::fs::write(&file, text).unwrap();
        assert_eq!(project.server_sh(&["status"]).await.code, Some(3));
        assert_eq!(project.done(&["stop", "demo"]).await, "nothing of demo runs\n");
        assert!(!file.exists());
    }
    std::fs::write(&file, format!("{}\n", std::process::id())).unwrap();
    project.done(&["start", "demo"]).await;
}
