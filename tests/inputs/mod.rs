//! Fuzzing: parsers of untrusted input get mutations of committed examples (`seeds/`). None may panic, take long, or
//! accept input that breaks a rule.
//!
//! `INPUTS=1000000 cargo test --test integration inputs::` runs a million cases of each. Failed cases are kept in
//! `regressions.txt` beside this file, and later runs try them first. The parser of Webots' output has a unit test:
//! `PROPTEST_CASES=1000000 cargo test --lib every_line_is_short`.

mod mutations;

use std::net::IpAddr;
use std::path::{Component, Path};
use std::time::Duration;

use actix_web::http::header::HeaderValue;
use actix_web::test::TestRequest;
use nix::time::ClockId;
use proptest::test_runner::{Config, FileFailurePersistence, TestRunner};
use webots_fleet::session::config::SessionConfig;
use webots_fleet::shared::config::{Configuration, load};
use webots_fleet::shared::domain::{Load, ProjectUrl, ServerReport};
use webots_fleet::shared::http::{Peer, TrustedProxies};
use webots_fleet::simulation::config::SimulationConfig;
use webots_fleet::simulation::container::{ProjectKind, WebotsYml};
use webots_fleet::simulation::protocol::{ClientRequest, failure};

/// The default number of cases of each kind.
const CASES: u32 = 3_000;
/// Limit of the processor time of one case; other load on the machine does not count. A parser that hangs exceeds it.
const BOUND: Duration = Duration::from_secs(2);

/// Runs a check on mutations of the lines of `seeds`. The check panics if a rule is broken.
fn try_many(seeds: &'static str, check: impl Fn(&[u8])) {
    let cases = std::env::var("INPUTS").map_or(CASES, |text| text.parse().unwrap());
    let failure_persistence = Some(Box::new(FileFailurePersistence::Direct("tests/inputs/regressions.txt")) as _);
    let mut runner = TestRunner::new(Config {
        cases,
        failure_persistence,
        ..Config::default()
    });
    let checked = runner.run(&mutations::of(seeds), |input| {
        let began = processor_time();
        check(&input);
        let took = processor_time() - began;
        assert!(took < BOUND, "it took {took:?}");
        Ok(())
    });
    checked.unwrap_or_else(|failure| panic!("{failure}"));
}

/// The processor time of this thread.
fn processor_time() -> Duration {
    ClockId::CLOCK_THREAD_CPUTIME_ID.now().unwrap().into()
}

/// Whether a text is one line without control characters.
fn is_one_line(text: &str) -> bool {
    !text.chars().any(char::is_control)
}

/// A web client's messages.
#[test]
fn any_message_is_answered_in_the_form_of_the_protocol() {
    try_many(include_str!("seeds/client_message.txt"), |input| {
        let text = String::from_utf8_lossy(input);
        match ClientRequest::parse(&text) {
            Ok(request) => {
                let told = match request {
                    ClientRequest::ResetController(file) => file,
                    ClientRequest::Resume(token) => token,
                    ClientRequest::Start(start) => start.url,
                    ClientRequest::Keep | ClientRequest::Nothing => String::new(),
                };
                assert!(told.len() <= text.len());
                assert!(serde_json::from_str::<serde_json::Value>(&text).is_ok());
            }
            Err(wrong) => {
                let [_, told] = failure(&wrong.into());
                assert!(told.starts_with("loading: Error: Wrong message: "), "{told}");
                // Webots' page inserts the text as HTML.
                assert!(!told.contains(['<', '>', '&']) && is_one_line(&told), "{told}");
                assert!(!told.contains("expected struct"), "{told}");
            }
        }
    });
}

/// Configuration files of both servers.
#[test]
fn any_configuration_is_read_or_refused_in_one_line() {
    let folder = tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .unwrap();
    let file = folder.path().join("configuration.json");
    try_many(include_str!("seeds/configuration.txt"), |input| {
        std::fs::write(&file, input).unwrap();
        is_read_or_refused::<SessionConfig>(&file);
        is_read_or_refused::<SimulationConfig>(&file);
    });
}

fn is_read_or_refused<C: Configuration>(file: &Path) {
    match load::<C>(file) {
        Ok(loaded) => {
            assert!(
                loaded.remarks().iter().all(|warning| is_one_line(warning)),
                "{:?}",
                loaded.remarks()
            )
        }
        Err(told) => {
            assert!(told.contains("configuration.json") && is_one_line(&told), "{told}");
        }
    }
}

/// The header in which web servers name the client that they forward; any client can forge it.
#[test]
fn only_a_trusted_proxy_is_believed_and_only_addresses_are() {
    let trusted: TrustedProxies = serde_json::from_str(r#"["127.0.0.0/8", "10.0.0.0/8"]"#).unwrap();
    let stranger: IpAddr = "203.0.113.9".parse().unwrap();
    let proxy: IpAddr = "127.0.0.1".parse().unwrap();
    try_many(include_str!("seeds/forwarded.txt"), |input| {
        let Ok(value) = HeaderValue::from_bytes(input) else {
            return;
        };
        let from = |address: IpAddr| {
            let request = TestRequest::default().peer_addr((address, 4000).into());
            trusted.peer(
                &request
                    .insert_header(("x-forwarded-for", value.clone()))
                    .to_http_request(),
            )
        };
        assert_eq!(from(stranger), Peer::Client(stranger));
        match from(proxy) {
            Peer::Client(address) | Peer::Proxy(address) if address == proxy => {}
            Peer::Client(address) => assert!(is_named(input, address), "{address} from {value:?}"),
            other => panic!("{other:?} from {value:?}"),
        }
    });
}

/// Whether a header contains an address, in any spelling.
fn is_named(header: &[u8], address: IpAddr) -> bool {
    let text = String::from_utf8_lossy(header);
    let pieces = || text.split([',', ';', '=', ' ', '\t', '"', '[', ']', '%']);
    let ports = pieces()
        .filter_map(|piece| piece.rsplit_once(':'))
        .map(|(host, _)| host);
    pieces()
        .chain(ports)
        .filter_map(|piece| piece.parse::<IpAddr>().ok())
        .any(|one| one.to_canonical() == address)
}

/// Answers of a simulation server, or of any host that is listed as one.
#[test]
fn a_report_is_a_load_and_short_lines_whatever_a_server_answers() {
    let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/a.wbt").unwrap();
    try_many(include_str!("seeds/report.txt"), |input| {
        let Ok(report) = ServerReport::parse(input) else {
            return;
        };
        assert!(
            report.load.percent().is_finite() && report.load.percent() >= 0.0,
            "{report:?}"
        );
        assert!(is_one_line(&report.version), "{report:?}");
        assert!(report.problem.as_deref().is_none_or(is_one_line), "{report:?}");
        if let Some(instances) = report.instances {
            assert!(instances.present() >= instances.running, "{report:?}");
        }
        // It returns, whatever rules were reported.
        std::hint::black_box(report.check(&world, report.load).is_ok());
        let again = serde_json::to_vec(&report).unwrap();
        assert!(ServerReport::parse(&again).is_ok(), "{report:?}");
    });
}

#[test]
fn a_load_is_a_number_from_0_whatever_a_server_answers() {
    try_many(include_str!("seeds/load.txt"), |input| {
        if let Ok(load) = Load::parse(input) {
            assert!(load.percent().is_finite() && load.percent() >= 0.0, "{load:?}");
        }
    });
}

/// `webots.yml` of a project.
#[test]
fn any_webots_yml_requests_nothing_outside_of_its_project() {
    try_many(include_str!("seeds/webots_yml.txt"), |input| {
        // Each example is one line of `seeds`, with escaped line ends.
        let text = String::from_utf8_lossy(input).replace("\\n", "\n").replace("\\r", "\r");
        let found = WebotsYml::parse(&text);
        assert!(
            found.warnings.iter().all(|warning| is_one_line(warning)),
            "{:?}",
            found.warnings
        );
        if let Some(message) = &found.project_type {
            let line = message.strip_suffix('\n').unwrap();
            assert!(
                is_one_line(line) && line.starts_with("type:") && line.len() <= 200,
                "{message:?}"
            );
        }
        if found.kind != ProjectKind::Default {
            let folder = &found.folder;
            assert!(
                folder.starts_with("webots-project") && is_one_line(folder),
                "{folder:?}"
            );
            assert!(!folder.contains([':', '$', '\\', '"', '\'', '`', '#']), "{folder:?}");
            let inside = found.folder_in_project();
            assert!(
                inside.components().all(|part| matches!(part, Component::Normal(_))),
                "{inside:?}"
            );
        }
    });
}

/// The URL of a world: no path outside the repository, no git option, nothing that a shell or a page would run.
#[test]
fn a_world_is_inside_of_its_repository_whatever_its_url_says() {
    try_many(include_str!("seeds/world_url.txt"), |input| {
        let text = String::from_utf8_lossy(input);
        match ProjectUrl::parse(&text) {
            Ok(world) => is_safe(&world),
            Err(wrong) => {
                let told = wrong.to_string();
                assert!(told.starts_with("Wrong Webots simulation URL: "), "{told}");
            }
        }
    });
}

fn is_safe(world: &ProjectUrl) {
    for segment in world.segments() {
        assert!(!segment.is_empty() && segment != "." && segment != "..", "{world:?}");
        assert!(!segment.contains(['/', '\\']) && is_one_line(segment), "{world:?}");
    }
    assert!(
        !world.host().starts_with('-') && !world.host().contains(['/', '@', ' ', '\\']),
        "{world:?}"
    );
    assert!(world.repository().starts_with("https://"), "{world:?}");
    assert!(world.world().to_ascii_lowercase().ends_with(".wbt"), "{world:?}");
    let inside = world.candidates();
    assert!(!inside.is_empty(), "{world:?}");
    for reading in inside {
        assert!(
            !reading.folder.starts_with('/') && !reading.folder.split('/').any(|name| name == ".git"),
            "{world:?}"
        );
    }
}
