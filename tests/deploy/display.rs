//! Real X servers: one that takes everybody, one that wants a cookie, and none.

use std::path::Path;
use std::process::{Child, Command, Stdio};

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
/// The family of hosts that an authority file names.
const NAMED: u16 = 256;

/// An authority file with these cookies, each for a host and the number of a display.
fn write_authority(file: &Path, cookies: &[(&str, &str, &[u8; 16])]) {
    let mut all = Vec::new();
    for (host, number, cookie) in cookies {
        all.extend(NAMED.to_be_bytes());
        for part in [host.as_bytes(), number.as_bytes(), b"MIT-MAGIC-COOKIE-1", cookie.as_slice()] {
            all.extend(u16::try_from(part.len()).unwrap().to_be_bytes());
            all.extend(part);
        }
    }
    std::fs::write(file, all).unwrap();
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
async fn check_tells_which_case_it_is_and_what_opens_a_display() {
    let _alone = display::alone().await;
    needs("xhost", "x11-xserver-utils");
    let folder = tempfile::tempdir().unwrap();
    let cookies = folder.path().join("authority");
    write_authority(&cookies, &[("", "", COOKIE)]);
    let (open, locked) = (Xvfb::start(None), Xvfb::start(Some(&cookies)));
    let told = |display: Option<&str>, configured: Option<&str>, authority: &Path| {
        let keys = configured.map_or(serde_json::json!({}), |display| serde_json::json!({ "display": display }));
        let (_, told) = super::preflight::check(&keys, |command| {
            command
                .env_remove("DISPLAY")
                .env("XAUTHORITY", authority)
                .envs(display.map(|display| ("DISPLAY", display)));
        });
        told.lines().find(|line| line.contains("display: ")).unwrap_or_else(|| panic!("{told}")).to_owned()
    };
    let (open, locked, unknown) = (open.display.as_str(), locked.display.as_str(), Path::new("/nowhere"));
    let (host, wrong) = (std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap(), b"sixteen numbers!");
    let (host, number) = (host.trim(), locked.trim_start_matches(':'));
    write_authority(&cookies, &[("another", "", wrong), (host, "9999", wrong), (host, number, COOKIE)]);
    let no_server = "warning: display: no display answers at :59000: start an X server";
    for (display, configured, authority, words) in [
        (open, None, unknown, format!("display: {open} answers (the environment variable DISPLAY names it)")),
        ("nonsense", Some(open), unknown, format!("display: {open} answers (the configuration names it)")),
        (locked, None, &cookies, format!("display: {locked} answers")),
        (":59000", None, unknown, no_server.to_owned()),
        ("nonsense", None, unknown, "warning: display: \"nonsense\" is no display".to_owned()),
    ] {
        let told = told(Some(display), configured, authority);
        assert!(told.starts_with(&words), "{words} is not in {told}");
    }
    let words = told(Some(":59000"), None, unknown);
    assert!(words.contains("Xvfb") && words.contains("nvidia-xconfig --allow-empty-initial-configuration"), "{words}");
    // Whether this machine has a display :0 or not.
    let line = told(None, None, unknown);
    assert!(line.contains(":0 ") || line.contains(":0:"), "{line}");
    assert!(line.ends_with("(DISPLAY is not set, and the configuration names no display)"), "{line}");

    let refused = told(Some(locked), None, unknown);
    let words = format!("warning: display: the display {locked} refuses this user (");
    assert!(refused.starts_with(&words) && refused.contains("Authorization required"), "{refused}");
    let opens = refused.split("run '").nth(1).and_then(|rest| rest.split('\'').next()).unwrap();
    assert!(opens.contains("xhost +si:localuser:"), "{refused}");
    let mut xhost = Command::new("sh");
    let output = xhost.args(["-c", opens]).env("DISPLAY", locked).env("XAUTHORITY", &cookies).output().unwrap();
    assert!(output.status.success(), "{opens}: {}", String::from_utf8_lossy(&output.stderr));
    let told = told(Some(locked), None, unknown);
    assert!(told.starts_with(&format!("display: {locked} answers")), "{told}");
}
