//! Real X servers: one that takes everybody, one that wants a cookie, and none.

use std::path::Path;
use std::process::{Child, Command, Stdio};

use webots_fleet::simulation::machine::display::check;

use crate::support::{display, needs};

/// A virtual X server, ended with the test.
struct Xvfb {
    child: Child,
    display: String,
}

impl Xvfb {
    /// Starts one with two screens; with an authority file, it takes only those who know a cookie in it.
    fn start(authority: Option<&Path>) -> Self {
        let mut command = Command::new("Xvfb");
        command.args("-displayfd 1 -screen 0 64x64x24 -screen 1 64x64x24 -nolisten tcp -noreset".split(' '));
        if let Some(file) = authority {
            command.arg("-auth").arg(file);
        }
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut number = String::new();
        std::io::BufRead::read_line(&mut std::io::BufReader::new(child.stdout.take().unwrap()), &mut number).unwrap();
        assert!(!number.trim().is_empty(), "Xvfb has ended");
        Self { child, display: format!(":{}", number.trim()) }
    }
}

impl Drop for Xvfb {
    fn drop(&mut self) {
        // In order: it removes its socket and its lock.
        let pid = nix::unistd::Pid::from_raw(i32::try_from(self.child.id()).unwrap());
        nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGTERM).ok();
        self.child.wait().ok();
    }
}

const COOKIE: &[u8; 16] = b"sixteen letters!";
/// The families of an authority file: every host, and the one of that name.
const EVERY: u16 = 0xffff;
const NAMED: u16 = 256;

/// An authority file with these cookies, each for a family, a host and the number of a display.
fn authority(folder: &Path, name: &str, cookies: &[(u16, &str, &str, &[u8; 16])]) -> std::path::PathBuf {
    let file = folder.join(name);
    let mut all = Vec::new();
    for (family, host, number, cookie) in cookies {
        all.extend(family.to_be_bytes());
        for part in [host.as_bytes(), number.as_bytes(), b"MIT-MAGIC-COOKIE-1", cookie.as_slice()] {
            all.extend(u16::try_from(part.len()).unwrap().to_be_bytes());
            all.extend(part);
        }
    }
    std::fs::write(&file, all).unwrap();
    file
}

#[actix_rt::test]
async fn an_open_display_is_told_from_one_that_refuses_until_it_is_opened_and_one_that_is_gone() {
    let _alone = display::alone().await;
    let folder = tempfile::tempdir().unwrap();
    let open = Xvfb::start(None);
    assert_eq!(check(&open.display), Ok(()));
    let gone = open.display.clone();
    drop(open);
    let words = check(&gone).unwrap_err();
    assert!(words.starts_with(&format!("no display answers at {gone}: ")) && words.contains("Xvfb"), "{words}");
    assert!(words.contains("nvidia-xconfig --allow-empty-initial-configuration"), "{words}");

    let cookies = authority(folder.path(), "all", &[(EVERY, "", "", COOKIE)]);
    let locked = Xvfb::start(Some(&cookies));
    let words = check(&locked.display).unwrap_err();
    let refused = format!("the display {} refuses this user (Authorization required", locked.display);
    assert!(words.starts_with(&refused), "{words}");
    // What is told opens it.
    needs("xhost", "x11-xserver-utils");
    let told = words.split("run '").nth(1).and_then(|rest| rest.split('\'').next()).unwrap();
    assert!(told.contains("xhost +si:localuser:"), "{words}");
    let mut xhost = Command::new("sh");
    xhost.args(["-c", told]).env("DISPLAY", &locked.display).env("XAUTHORITY", &cookies);
    let output = xhost.output().unwrap();
    assert!(output.status.success(), "{told}: {}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(check(&locked.display), Ok(()));
}

#[actix_rt::test]
async fn the_screen_of_each_gpu_is_checked() {
    let _alone = display::alone().await;
    let library = crate::simulation::readings::gpu_driver();
    let server = Xvfb::start(None);
    let [first, second, missing] = [0, 1, 2].map(|screen| format!("{}.{screen}", server.display));
    for (displays, words) in [
        ([&first, &second], format!("display: {first}, {second} answer (displays names them)\n")),
        ([&first, &missing], format!("warning: display: what is at {missing} does not answer as a display does: ")),
    ] {
        let keys = serde_json::json!({"gpus": "spread", "displays": displays, "display": ":59000"});
        let (_, told) = super::preflight::check(&keys, |command| {
            command.env("LD_LIBRARY_PATH", library.path());
        });
        assert!(told.contains(&words), "{words} is not in\n{told}");
        assert!(told.contains("\nGPUs: simulations are spread over Stand-in A, Stand-in B\n"), "{told}");
    }
}

#[actix_rt::test]
async fn check_tells_which_case_it_is() {
    let _alone = display::alone().await;
    let folder = tempfile::tempdir().unwrap();
    let open = Xvfb::start(None);
    let cookies = authority(folder.path(), "all", &[(EVERY, "", "", COOKIE)]);
    let locked = Xvfb::start(Some(&cookies));
    let (open, locked) = (open.display.as_str(), locked.display.as_str());
    let (host, wrong) = (std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap(), b"sixteen numbers!");
    let (host, number) = (host.trim(), locked.trim_start_matches(':'));
    let several = [(NAMED, "another", "", wrong), (NAMED, host, "9999", wrong), (NAMED, host, number, COOKIE)];
    let several = authority(folder.path(), "several", &several);
    let table = [
        (Some(open), None, None, format!("display: {open} answers (the environment variable DISPLAY names it)")),
        (Some("nonsense"), Some(open), None, format!("display: {open} answers (the configuration names it)")),
        (Some(locked), None, None, format!("warning: display: the display {locked} refuses this user")),
        (Some(locked), None, Some(cookies.to_str().unwrap()), format!("display: {locked} answers")),
        (Some(locked), None, Some(several.to_str().unwrap()), format!("display: {locked} answers")),
        (Some(":59000"), None, None, "warning: display: no display answers at :59000: start an X server".to_owned()),
        (Some("nonsense"), None, None, "warning: display: \"nonsense\" is no display".to_owned()),
    ];
    for (display, configured, authority, words) in table {
        let (_, told) = super::preflight::check(
            &configured.map(|display| serde_json::json!({"display": display})).unwrap_or(serde_json::json!({})),
            |command| {
                command.env_remove("DISPLAY").env("XAUTHORITY", authority.unwrap_or("/nowhere"));
                if let Some(display) = display {
                    command.env("DISPLAY", display);
                }
            },
        );
        assert!(told.lines().any(|line| line.starts_with(&words)), "{words} is not in\n{told}");
    }
    // Whether this machine has a display :0 or not.
    let (_, told) = super::preflight::check(&serde_json::json!({}), |command| {
        command.env_remove("DISPLAY");
    });
    let line = told.lines().find(|line| line.contains("display: ")).unwrap_or_else(|| panic!("{told}"));
    assert!(line.contains(":0 ") || line.contains(":0:"), "{line}");
    assert!(line.ends_with("(DISPLAY is not set, and the configuration names no display)"), "{line}");
}
