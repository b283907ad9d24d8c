//! Checks of the display, with and without an X server.

use std::process::{Child, Command, Stdio};

use crate::support::display;

/// A virtual X server, stopped on drop.
struct Xvfb {
    child: Child,
    display: String,
}

impl Xvfb {
    /// Starts one with two screens.
    fn start() -> Self {
        let mut command = Command::new("Xvfb");
        command.args("-displayfd 1 -screen 0 64x64x24 -screen 1 64x64x24 -nolisten tcp -noreset".split(' '));
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut number = String::new();
        std::io::BufRead::read_line(&mut std::io::BufReader::new(child.stdout.take().unwrap()), &mut number).unwrap();
        assert!(!number.trim().is_empty(), "Xvfb has ended");
        Self {
            child,
            display: format!(":{}", number.trim()),
        }
    }
}

impl Drop for Xvfb {
    fn drop(&mut self) {
        // SIGTERM lets it remove its socket and lock file.
        let pid = nix::unistd::Pid::from_raw(i32::try_from(self.child.id()).unwrap());
        nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGTERM).ok();
        self.child.wait().ok();
    }
}

#[actix_rt::test]
async fn the_display_of_each_gpu_is_checked() {
    needs!("Xvfb");
    let _alone = display::alone().await;
    let server = Xvfb::start();
    let [first, second] = [0, 1].map(|screen| format!("{}.{screen}", server.display));
    let missing = ":59000.1".to_owned();
    for (displays, words) in [
        (
            [&first, &second],
            format!("display: an X server answers at {first}, {second}\n"),
        ),
        (
            [&first, &missing],
            format!("warning: display: no display answers at {missing}: "),
        ),
    ] {
        let keys = serde_json::json!({"gpus": "spread", "displays": displays, "display": ":59000"});
        let (_, told) = super::preflight::check(&keys, |_| ());
        assert!(told.contains(&words), "{words} is not in\n{told}");
    }
}

#[actix_rt::test]
async fn check_tells_whether_a_display_answers() {
    needs!("Xvfb");
    let _alone = display::alone().await;
    let server = Xvfb::start();
    let open = server.display.as_str();
    let answers = format!("display: an X server answers at {open}");
    for (display, configured, words) in [
        (Some(open), None, answers.as_str()),
        (Some("nonsense"), Some(open), &answers),
        (
            Some(":59000"),
            None,
            "warning: display: no display answers at :59000: start an X server",
        ),
        // A display of another host.
        (
            Some("127.0.0.1:59000"),
            None,
            "warning: display: no display answers at 127.0.0.1:59000: start",
        ),
        (Some("nonsense"), None, "warning: display: \"nonsense\" is no display"),
        // Matches both results: this machine may have a display :0.
        (None, None, "answers at :0"),
    ] {
        let keys = configured.map_or(
            serde_json::json!({}),
            |display| serde_json::json!({ "display": display }),
        );
        let (_, told) = super::preflight::check(&keys, |command| {
            command
                .env_remove("DISPLAY")
                .envs(display.map(|display| ("DISPLAY", display)));
        });
        assert!(told.contains(words), "{words} is not in {told}");
    }
}
