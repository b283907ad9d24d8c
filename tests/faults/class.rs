//! The load during faults: a rehearsal.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use serde_json::Value;
use tokio::process::{Child, Command};

use crate::support::arm;

/// Number of clients that come and go.
const CLIENTS: u32 = 8;

/// A class that comes and goes. It is killed when this value is dropped.
pub struct Class {
    child: Child,
    file: PathBuf,
}

impl Class {
    /// Makes it come to a session server again and again for this long. The results are written into the folder.
    pub fn start(url: &str, folder: &Path, time: Duration) -> Self {
        let file = folder.join("class.json");
        let mut command = Command::new(env!("CARGO_BIN_EXE_rehearse"));
        command.args([url, "--world", &arm(), "--over", "1s", "--stay", "3s"]);
        command.args([
            "--patience",
            "20s",
            "--misbehave",
            "reload=10,drop=10,sleep=5,vanish=5,hasty=15",
        ]);
        command.args([
            "--clients",
            &CLIENTS.to_string(),
            "--soak",
            &format!("{}s", time.as_secs()),
        ]);
        command
            .arg("--json")
            .arg(&file)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .kill_on_drop(true);
        Self {
            child: command.spawn().unwrap(),
            file,
        }
    }

    /// Waits until all clients have left. Returns the results.
    pub async fn end(mut self) -> Value {
        actix_rt::time::timeout(Duration::from_secs(90), self.child.wait())
            .await
            .expect("the class ends")
            .unwrap();
        serde_json::from_str(&std::fs::read_to_string(&self.file).unwrap()).unwrap()
    }
}
