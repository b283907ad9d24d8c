//! A network namespace of this test and the programs that it starts, which can lose packets.

use std::process::{Command, Stdio};

use nix::sched::{CloneFlags, unshare};

#[derive(Clone, Copy)]
pub struct Network(());

impl Network {
    /// Moves this thread, and what it starts, into a new network namespace. `None` if that is not allowed, or if
    /// packets can't be filtered.
    pub fn hide_from_others() -> Option<Self> {
        let trial =
            "ip link set lo up && iptables -A INPUT -p tcp -m statistic --mode random --probability 0.5 -j DROP";
        if !done("unshare", &["--net", "sh", "-c", trial]) {
            return None;
        }
        unshare(CloneFlags::CLONE_NEWNET).unwrap();
        assert!(
            done("ip", &["link", "set", "lo", "up"]),
            "the loopback is not to be had"
        );
        Some(Self(()))
    }

    /// Loses this share of packets from and to these ports (`PORT` or `FIRST:LAST`) until the result is dropped.
    pub fn lose(self, share: f64, ports: &[String]) -> Lost {
        for ports in ports {
            for side in ["--sport", "--dport"] {
                let share = share.to_string();
                let arguments = [
                    "-w",
                    "-A",
                    "INPUT",
                    "-p",
                    "tcp",
                    side,
                    ports,
                    "-m",
                    "statistic",
                    "--mode",
                    "random",
                ];
                assert!(done(
                    "iptables",
                    &[&arguments[..], &["--probability", &share, "-j", "DROP"]].concat()
                ));
            }
        }
        Lost
    }
}

/// Packets get lost until this value is dropped.
pub struct Lost;

impl Drop for Lost {
    fn drop(&mut self) {
        // There are no other rules in this network.
        done("iptables", &["-w", "-F", "INPUT"]);
    }
}

fn done(program: &str, arguments: &[&str]) -> bool {
    let mut command = Command::new(program);
    command
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}
