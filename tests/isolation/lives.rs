//! What ends with a simulation at each level, and how.

use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::simulation::scene::{gone_within, nothing_left};
use crate::support::{Client, DEMO, Webots, server_of, until};

/// The processes that have this word in their command line.
pub fn named(word: &str) -> Vec<i32> {
    let all = procfs::process::all_processes().unwrap().flatten();
    let has = |one: &procfs::process::Process| one.cmdline().is_ok_and(|words| words.iter().any(|one| one == word));
    all.filter(has).map(|one| one.pid()).collect()
}

/// A number of seconds that no other process sleeps.
pub fn long() -> String {
    format!("1000.{}", rand::random::<u64>())
}

#[actix_rt::test]
async fn what_hides_on_purpose_ends_with_its_sandbox() {
    for (level, reason) in [("sandbox", "client"), ("sandbox", "kill"), ("none", "client")] {
        let hidden = long();
        let webots = Webots::script(&format!("(env -i setsid sleep {hidden} &)\n{DEMO} \"$@\" & wait"));
        let builder = server_of(webots, 1).set("isolation", level);
        let mut server = builder.set("timing.grace", 0.5).start().await;
        let client = Client::ready(&server).await;
        until("it hides", async || named(&hidden).len() == 1).await;
        if reason == "client" {
            client.leave().await;
            nothing_left(&server, 1).await;
        } else {
            server.signal(Signal::SIGKILL);
            server.ended().await;
        }
        if level == "sandbox" {
            until("it has ended", async || named(&hidden).is_empty()).await;
        } else {
            // This is what the level does not promise.
            assert_eq!(named(&hidden).len(), 1);
            kill(Pid::from_raw(named(&hidden)[0]), Signal::SIGKILL).unwrap();
        }
    }
}

#[actix_rt::test]
async fn a_simulation_has_its_grace_time_at_each_level() {
    for level in ["none", "sandbox"] {
        let folder = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
        let written = folder.path().join("written");
        // As Webots' launcher does: it hands SIGTERM on, and waits.
        let work = format!("sleep 0.3; echo saved > \"{}\"", written.display());
        let webots = Webots::script(&format!("trap '{work}; exit 0' TERM\n{DEMO} \"$@\" & wait"));
        let builder = server_of(webots, 1).set("isolation", level);
        let server = builder.set("sandbox.writable", folder.path().to_str().unwrap()).start().await;
        let client = Client::ready(&server).await;
        client.leave().await;
        nothing_left(&server, 1).await;
        assert_eq!(std::fs::read_to_string(&written).unwrap_or_default(), "saved\n", "{level}");
    }
}

#[actix_rt::test]
async fn a_simulation_that_takes_no_notice_is_killed_after_its_grace_time() {
    for level in ["none", "sandbox"] {
        let webots = Webots::script(&format!("trap '' TERM\n{DEMO} \"$@\" &\nwhile true; do wait; sleep 0.1; done"));
        let builder = server_of(webots, 1).set("isolation", level);
        let server = builder.set("timing.grace", 0.5).start().await;
        let client = Client::ready(&server).await;
        let left = Instant::now();
        client.leave().await;
        let took = gone_within(0.5, left, &server).await;
        assert!(took >= Duration::from_millis(500), "{level}: it was killed after {took:?}");
    }
}
