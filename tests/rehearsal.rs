//! Black-box tests of `rehearse`: its verdict on a large enough fleet, on one that is too small, and without a fleet.

use std::process::{Output, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use tokio::process::{Child, Command};

use crate::support::authority::Authority;
use crate::support::stand_in::{Script, StandIn};
use crate::support::{SOON, Server, WORLD, arm, demo_server, ports, session_server, until};

/// Timeout of a rehearsal.
const BOUND: Duration = Duration::from_secs(90);

/// A fleet of one simulation server.
struct Fleet {
    session: Server,
    simulation: Server,
}

impl Fleet {
    async fn with_places(places: u16) -> Self {
        let simulation = demo_server(places).start().await;
        // Other load on this machine must not make the server full.
        let session = session_server(&[simulation.address()])
            .set("loadThreshold", 1000)
            .start()
            .await;
        Self { session, simulation }
    }

    async fn rehearse(&self, arguments: &[&str]) -> Said {
        rehearse(&self.session.url(""), arguments).await
    }
}

/// The exit code and the output of a rehearsal.
#[derive(Debug)]
struct Said {
    code: Option<i32>,
    out: String,
    err: String,
}

async fn rehearse(fleet: &str, arguments: &[&str]) -> Said {
    said(command(fleet).args(arguments)).await
}

fn command(fleet: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rehearse"));
    command
        .arg(fleet)
        .args(["--world", &arm()])
        .stdin(Stdio::null())
        .kill_on_drop(true);
    command
}

async fn said(command: &mut Command) -> Said {
    of(actix_rt::time::timeout(BOUND, command.output())
        .await
        .expect("it ends")
        .unwrap())
}

fn of(output: Output) -> Said {
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    Said {
        code: output.status.code(),
        out: text(output.stdout),
        err: text(output.stderr),
    }
}

/// One client that stays for a second, at any pace.
const ONE: [&str; 8] = ["--clients", "1", "--over", "0s", "--stay", "1s", "--real-time", "0"];

#[actix_rt::test]
async fn a_class_notices_no_upgrade() {
    let fleet = Fleet::with_places(8).await;
    let class = [
        "--clients",
        "6",
        "--over",
        "4s",
        "--stay",
        "6s",
        "--real-time",
        "0.1",
        "--misbehave",
        "return=50",
    ];
    let upgrading = async {
        for clients in [2, 4] {
            until("clients run", async || {
                fleet.simulation.simulations().await.len() >= clients
            })
            .await;
            let (succeeds, told) = fleet.simulation.upgrade().await;
            assert!(succeeds, "{told}");
        }
    };
    let (said, ()) = tokio::join!(fleet.rehearse(&class), upgrading);
    assert!(said.code == Some(0) && said.out.contains("All 6 fit."), "{said:?}");
}

#[actix_rt::test]
async fn a_class_that_fits_is_told_so() {
    let fleet = Fleet::with_places(3).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("class.json");
    let class = [
        "--clients",
        "3",
        "--over",
        "0s",
        "--stay",
        "5s",
        "--real-time",
        "0.1",
        "--expect",
        "3",
        "--json",
    ];
    let said = fleet.rehearse(&[&class[..], &[file.to_str().unwrap()]].concat()).await;
    assert!(said.code == Some(0) && said.out.contains("All 3 fit."), "{said:?}");
    assert!(said.out.contains(": 3 clients at once, each for 5s"), "{said:?}");
    let report: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    assert_eq!(
        (&report["seats"]["given"], &report["seats"]["fit"]),
        (&3.into(), &3.into()),
        "{report}"
    );
    let visits = report["visits"].as_array().unwrap();
    let has_pace = |visit: &Value| ["p5", "median"].iter().all(|name| visit["realTime"][name].is_f64());
    assert!(visits.len() == 3 && visits.iter().all(has_pace), "{report}");
}

#[actix_rt::test]
async fn a_class_that_does_not_fit_is_reported_with_reasons() {
    let fleet = Fleet::with_places(1).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("class.json");
    let class = [
        "--clients",
        "2",
        "--over",
        "1s",
        "--stay",
        "5s",
        "--real-time",
        "0.1",
        "--json",
        file.to_str().unwrap(),
    ];
    let said = fleet.rehearse(&class).await;
    let report: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    assert_eq!(said.code, Some(0), "{report}");
    let waiting = report["times"]
        .as_array()
        .unwrap()
        .iter()
        .find(|row| row["step"] == "waiting")
        .unwrap();
    assert!(
        waiting["worst"].as_f64().unwrap() > 1.5,
        "one waited until the other had left: {report}"
    );
    // The first client stays longer than the second one waits.
    let stays = ["--stay", "10s", "--real-time", "0", "--patience", "5s", "--expect", "2"];
    let said = fleet.rehearse(&[&class[..4], &stays].concat()).await;
    assert!(said.code == Some(1) && said.out.contains("1 of 2"), "{said:?}");
}

#[actix_rt::test]
async fn a_class_that_reloads_comes_back_to_its_simulations() {
    let fleet = Fleet::with_places(4).await;
    let arguments = [
        "--clients",
        "2",
        "--over",
        "0s",
        "--stay",
        "8s",
        "--misbehave",
        "return=100",
        "--expect",
        "2",
    ];
    let said = fleet.rehearse(&[&arguments[..], &["--real-time", "0"]].concat()).await;
    assert_eq!(said.code, Some(0), "{said:?}");
    let status = fleet.simulation.status().await;
    assert_eq!(status["instances"]["arrivals"], 2, "they began anew: {said:?}");
}

#[actix_rt::test]
async fn the_acceptance_run_finds_the_demo_as_expected() {
    let fleet = Fleet::with_places(1).await;
    let Said { code, out, err } = fleet.rehearse(&["--explain"]).await;
    assert!(
        code == Some(0) && out.contains("| step | at | took | expected | came | |"),
        "{out}{err}"
    );
    assert!(
        out.contains("| availability |") && out.matches("| ok |").count() >= 15,
        "{out}"
    );
}

#[actix_rt::test]
async fn a_fleet_that_can_not_be_rehearsed_is_refused_in_one_line() {
    let ((_taken, port), fleet) = (ports::dead_port(), Fleet::with_places(1).await);
    let no_session_server = (1, "error: ws://", ": no session server, maybe a simulation server\n");
    for (url, arguments, (code, begin, end)) in [
        (format!("http://127.0.0.1:{port}"), &ONE[..], (1, "error: ", "\n")),
        // Nothing is sent: the address is reserved for documentation.
        (
            "http://192.0.2.1:1999".to_owned(),
            &ONE[..],
            (
                2,
                "error: http://192.0.2.1:1999/ is not this machine: --yes loads it with 1 clients at once",
                "\n",
            ),
        ),
        (fleet.simulation.url(""), &ONE[..], no_session_server),
        (fleet.simulation.url(""), &["--explain"], no_session_server),
    ] {
        let said = rehearse(&url, arguments).await;
        assert!(said.code == Some(code) && said.err.lines().count() == 1, "{said:?}");
        assert!(said.err.starts_with(begin) && said.err.ends_with(end), "{said:?}");
    }
}

#[actix_rt::test]
async fn a_fleet_behind_https_is_rehearsed() {
    let lab = Authority::new();
    let other = Authority::new();
    let script = Script {
        session: vec!["wss://{}"],
        client: vec!["shutdownTimeout: 60", "webots:wss://{}/webots"],
        ..Script::default()
    };
    let fleet = StandIn::start_behind_tls(script, &lab.issue(&["localhost"])).await;
    let url = format!("https://{}", fleet.address);
    // Long enough to poll the load, once a second.
    let class = ["--clients", "1", "--over", "0s", "--stay", "5s", "--real-time", "0"];
    let Said { code, out, err } = said(command(&url).args(class).env("SSL_CERT_FILE", lab.file())).await;
    assert!(code == Some(0) && out.contains("All 1 fit."), "{out}{err}");
    assert!(
        out.contains(" 1 % "),
        "the load of the simulation server is seen: {out}"
    );
    let Said { code, err, .. } = said(command(&url).args(ONE).env("SSL_CERT_FILE", other.file())).await;
    assert!(
        code == Some(1) && err.contains("its certificate is not trusted") && err.lines().count() == 1,
        "{err}"
    );
}

#[actix_rt::test]
async fn who_gets_no_slot_waits_for_the_next_one() {
    let full = "Error: no simulation server available at the moment.";
    let never = "Error: no simulation server accepts https://github.com/lab/arm.";
    let given_up = format!("None fits; 1 got none: no simulation within 4s: {full}");
    let retold = "Error: come back later.";
    for (session, reason, verdict, code, asked) in [
        (vec![full, full, "ws://{}"], None, "All 1 fit.", 0, 3..=3),
        // There is a pause between requests.
        (vec![full], None, given_up.as_str(), 1, 2..=5),
        // A permanent refusal is not retried.
        (
            vec![never],
            None,
            "1 got none: Error: no simulation server accepts",
            1,
            1..=1,
        ),
        // The code decides, if there is one.
        (
            vec![retold, "ws://{}"],
            Some("no-server-available"),
            "All 1 fit.",
            0,
            2..=2,
        ),
        (
            vec![full],
            Some("repository-blocked"),
            "1 got none: Error: no",
            1,
            1..=1,
        ),
    ] {
        let fleet = StandIn::start(Script {
            session,
            reason,
            ..Script::default()
        })
        .await;
        let patience = if code == 0 { "60s" } else { "4s" };
        let arguments = [&ONE[..], &["--patience", patience]].concat();
        let said = rehearse(&format!("http://{}", fleet.address), &arguments).await;
        assert!(said.code == Some(code) && said.out.contains(verdict), "{said:?}");
        let times = fleet.asked("/session").len();
        assert!(asked.contains(&times), "it was asked {times} times");
    }
}

/// The output of an acceptance run with a scripted fleet.
async fn explained(script: Script) -> String {
    let fleet = StandIn::start(script).await;
    let said = rehearse(&format!("http://{}", fleet.address), &["--explain", "--patience", "6s"]).await;
    assert_eq!(said.code, Some(1), "{said:?}");
    said.out
}

#[actix_rt::test]
async fn an_acceptance_run_ends_at_the_step_that_fails() {
    let client = |text| Script {
        client: vec![text],
        ..Script::default()
    };
    let webots = |texts| Script {
        webots: texts,
        ..Script::default()
    };
    let cases = [
        (
            client("loading: wait"),
            "| Webots is ready |",
            ["not within 6 s", "| **differs** |"],
        ),
        (
            webots(vec!["world:a"]),
            "| scene |",
            ["`world:`, ", "then not within 6 s"],
        ),
        (
            client("error: no display"),
            "| Webots is ready |",
            ["`error: no display`", ""],
        ),
        (
            webots(vec!["world:a", "error: no such world"]),
            "| scene |",
            ["`world:`, then `error: no such world`", ""],
        ),
    ];
    let all = cases.map(|(script, step, words)| async move {
        let said = explained(script).await;
        let line = said.lines().find(|line| line.starts_with(step)).unwrap();
        assert!(words.iter().all(|words| line.contains(words)), "{said}");
        assert!(step != "| scene |" || said.contains("steps differ: "), "{said}");
    });
    futures_util::future::join_all(all).await;
}

/// A simulation server whose simulations share one processor, a twenty-fifth of which each needs at least, and its session
/// server.
async fn fleet_on_one_processor(target: f64) -> Fleet {
    let builder = demo_server(60)
        .before("taskset -pc 0 $$ > /dev/null")
        .set("streaming", "relay")
        .set("isolation", "none")
        .set("realTime.target", target);
    let (first, rest) = WORLD.split_once('\n').unwrap();
    let world = format!("{first}\n#demo-simulator: work=0.04\n{rest}");
    builder.forge().commit("lab/arm", "main", &[("worlds/a.wbt", &world)]);
    let simulation = builder.start().await;
    let session = session_server(&[simulation.address()])
        .before("taskset -pc 1 $$ > /dev/null")
        // Half of the machine is idle, so that its load is no limit. Other programs must not be one.
        .set("loadThreshold", 1000)
        .start()
        .await;
    Fleet { session, simulation }
}

/// The mean pace of each client of a rehearsal, in the order in which they got their places, and the mean of what the
/// server has recorded for it.
async fn paces(fleet: &Fleet, report: &Value) -> Vec<(f64, f64)> {
    let visits = report["visits"].as_array().unwrap().iter();
    let mut seen: Vec<(f64, f64)> = visits
        .filter(|visit| visit["outcome"]["outcome"] == "ran")
        .map(|visit| {
            let pace = visit["pace"].as_array().unwrap()[1..].iter();
            let pace: Vec<f64> = pace.map(|pace| pace["factor"].as_f64().unwrap()).collect();
            let granted = visit["asked"].as_f64().unwrap() + visit["steps"]["waiting"].as_f64().unwrap();
            #[expect(clippy::cast_precision_loss, reason = "a few numbers")]
            (granted, pace.iter().sum::<f64>() / pace.len() as f64)
        })
        .collect();
    seen.sort_by(|one, other| one.0.total_cmp(&other.0));
    let file = fleet.simulation.folder.join("log/simulation/simulations.csv");
    let read = || std::fs::read_to_string(&file).unwrap_or_default();
    until("all are recorded", async || read().lines().count() > seen.len()).await;
    let mut recorded: Vec<(u32, f64)> = read()
        .lines()
        .skip(1)
        .map(|line| {
            let number = line.split(',').next().unwrap().rsplit('-').next().unwrap();
            (
                number.parse().unwrap(),
                line.rsplit(',').nth(1).unwrap().parse().unwrap(),
            )
        })
        .collect();
    recorded.sort_by_key(|(number, _)| *number);
    let recorded = recorded.into_iter().map(|(_, percent)| percent / 100.0);
    seen.into_iter().map(|(_, pace)| pace).zip(recorded).collect()
}

/// Plays a class on one processor. Returns the share of the simulations that kept 0.9 of real time, and their number.
async fn class_on_one_processor(target: f64) -> (f64, f64) {
    let fleet = fleet_on_one_processor(target).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("class.json");
    let url = fleet.session.url("");
    let mut command = Command::new("taskset");
    command
        .args(["-c", "1", env!("CARGO_BIN_EXE_rehearse"), &url, "--world", &arm()])
        .args(["--clients", "40", "--over", "60s", "--stay", "45s", "--json"])
        .arg(&file);
    let said = of(actix_rt::time::timeout(4 * BOUND, command.output())
        .await
        .expect("it ends")
        .unwrap());
    println!("realTime.target {target}:\n{}", said.out);
    let report: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    let paces = paces(&fleet, &report).await;
    let differences = paces.iter().map(|(seen, recorded)| ((recorded - seen) / seen).abs());
    #[expect(clippy::cast_precision_loss, reason = "a few numbers")]
    let difference = differences.sum::<f64>() / paces.len() as f64;
    println!(
        "the server's factor and that of rehearse differ by {:.1} % in the mean",
        100.0 * difference
    );
    assert!(difference < 0.02, "{paces:.3?}");
    let number = |what: &str| report["seats"][what].as_f64().unwrap();
    (number("fit") / number("given"), number("given"))
}

#[actix_rt::test]
#[ignore = "it takes eight minutes"]
async fn on_a_quiet_machine_places_by_real_time_keep_it_where_the_load_does_not() {
    let (kept, given) = class_on_one_processor(0.9).await;
    let (by_load, _) = class_on_one_processor(0.0).await;
    println!(
        "of {given} clients {:.0} % keep real time, by load {:.0} %",
        100.0 * kept,
        100.0 * by_load
    );
    assert!(
        kept >= 0.95 && by_load < 0.95 && given > 10.0,
        "{kept} of {given}, {by_load} by load"
    );
}

#[actix_rt::test]
async fn a_class_grows_until_simulations_are_slower_than_real_time() {
    // Each needs more than a third of a processor, of which all share one. Of three clients in vain each leaves its place to
    // the next.
    let builder = demo_server(3)
        .before("taskset -pc 0 $$ > /dev/null")
        .set("streaming", "relay")
        .set("isolation", "none")
        .set("realTime.target", 0);
    let (first, rest) = WORLD.split_once('\n').unwrap();
    let world = format!("{first}\n#demo-simulator: work=0.4\n{rest}");
    builder.forge().commit("lab/arm", "main", &[("worlds/a.wbt", &world)]);
    let simulation = builder.start().await;
    let session = session_server(&[simulation.address()])
        .set("loadThreshold", 1000)
        .start()
        .await;
    let fleet = Fleet { session, simulation };
    let said = fleet.rehearse(&["--find", "--clients", "8", "--expect", "9"]).await;
    let address = fleet.simulation.address();
    let line = said.out.lines().find(|line| line.starts_with(&address));
    let line = line.unwrap_or_else(|| panic!("{said:?}"));
    let fit: u32 = line.rsplit("\"maxConnections\": ").next().unwrap().parse().unwrap();
    // On a busy machine not even two fit.
    assert!(fit <= 2, "{said:?}");
    assert!(
        line.contains(&format!("{fit} fit, with {} real time is 0.", fit + 1)),
        "{said:?}"
    );
    assert!(
        said.out
            .contains("Clients are sent only to servers on which no more fit. "),
        "{said:?}"
    );
    assert_eq!(said.code, Some(1), "nine had to fit: {said:?}");
}

#[actix_rt::test]
async fn a_class_that_finds_no_more_places_says_so() {
    let fleet = Fleet::with_places(2).await;
    let said = fleet
        .rehearse(&["--find", "--real-time", "0", "--patience", "20s"])
        .await;
    assert!(
        said.out.contains("2 fit, perhaps more; \"maxConnections\": 2\n"),
        "{said:?}"
    );
    assert!(
        said.out
            .contains("Client 3 got no simulation that runs: no simulation within 20s"),
        "{said:?}"
    );
    assert_eq!(said.code, Some(0), "{said:?}");
}

fn signal(child: &Child, signal: Signal) {
    kill(Pid::from_raw(i32::try_from(child.id().unwrap()).unwrap()), signal).unwrap();
}

#[actix_rt::test]
async fn an_interrupted_class_tells_what_was_seen_until_then() {
    futures_util::future::join(interrupt(Signal::SIGINT), interrupt(Signal::SIGTERM)).await;
}

async fn interrupt(by: Signal) {
    let fleet = StandIn::start(Script::default()).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("class.json");
    let mut command = command(&format!("http://{}", fleet.address));
    command
        .args(["--clients", "2", "--over", "10m", "--stay", "10m", "--json"])
        .arg(&file);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    until("the first client connects to Webots", async || {
        !fleet.asked("/webots").is_empty()
    })
    .await;
    // Waits for some polls of the load, one a second, so that the simulation runs.
    let before = fleet.asked("/load").len();
    until("time passes", async || fleet.asked("/load").len() > before + 2).await;
    signal(&child, by);
    let said = of(actix_rt::time::timeout(SOON, child.wait_with_output())
        .await
        .expect("it ends")
        .unwrap());
    assert_eq!(said.code, Some(130), "{said:?}");
    assert!(
        said.out.contains(", interrupted\n") && said.out.contains("| ran, their end unseen "),
        "{said:?}"
    );
    let report: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    assert_eq!(
        (&report["seats"]["asked"], &report["seats"]["unseen"]),
        (&1.into(), &1.into()),
        "{report}"
    );
    assert!(
        report["interrupted"] == true && !report["visits"][0]["pace"].as_array().unwrap().is_empty(),
        "{report}"
    );
}

#[actix_rt::test]
async fn what_can_not_be_done_is_told_before_anything_is_begun() {
    let told = async |command: &mut Command| {
        let said = said(command).await;
        assert_eq!(said.code, Some(2), "{said:?}");
        said.err
    };
    // No server is there: a rehearsal that began would report that instead.
    let fleet = "http://127.0.0.1:1";
    let error = told(command(fleet).args(["--json", "/nowhere/a.json"])).await;
    assert!(
        error.starts_with("error: /nowhere/a.json can't be written: "),
        "{error}"
    );
    let error = told(&mut command("http://me:secret@127.0.0.1:1")).await;
    assert!(
        error.contains("a user name or a password") && !error.contains("secret"),
        "{error}"
    );
    let mut limited = Command::new("prlimit");
    limited.args([
        "--nofile=100",
        env!("CARGO_BIN_EXE_rehearse"),
        fleet,
        "--world",
        &arm(),
        "--clients",
        "50",
    ]);
    let error = told(&mut limited).await;
    assert_eq!(
        error,
        "error: 50 clients need 264 open files, and the system allows 100 (ulimit -Hn)\n"
    );
}

#[actix_rt::test]
async fn no_text_of_a_server_steers_the_terminal_or_fills_it() {
    const STEERING: &str = "loading: Error: \u{1b}]0;owned\u{7}\u{1b}[31m one\r\nAll 3 fit.\u{202e}two";
    let long: &'static str = Box::leak(format!("loading: Error: {}", "x".repeat(500_000)).into_boxed_str());
    let larger: &'static str = Box::leak("x".repeat(2 << 20).into_boxed_str());
    let session = |text| Script {
        session: vec![text],
        ..Script::default()
    };
    let client = |text| Script {
        client: vec![text],
        ..Script::default()
    };
    let webots = |text| Script {
        webots: vec![text],
        ..Script::default()
    };
    for script in [
        session("no \u{1b}[31mred\r\n\u{202e}"),
        session("ws://{}/\u{1b}[31mred\u{202e}"),
        client(STEERING),
        client(long),
        client(larger),
        webots("error: \u{1b}[31mred\r\n\u{202e}"),
    ] {
        let stand_in = StandIn::start(script).await;
        let fleet = format!("http://{}", stand_in.address);
        for more in [&ONE[..], &["--explain"]] {
            let Said { out, err, .. } = rehearse(&fleet, &[more, &["--patience", "20s"]].concat()).await;
            let said = out + &err;
            assert!(!said.contains(['\u{1b}', '\u{7}', '\r', '\u{202e}']), "{said:?}");
            assert!(!said.contains("\nAll 3 fit."), "{said}");
            assert!(said.len() < 20_000, "{} bytes", said.len());
        }
    }
}
