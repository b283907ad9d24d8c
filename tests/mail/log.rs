//! The log lines of this process.

use std::sync::{Mutex, Once};

use crate::support::holds_soon;

static LOG: Mutex<Vec<(log::Level, String)>> = Mutex::new(Vec::new());

struct Keeper;

impl log::Log for Keeper {
    fn enabled(&self, metadata: &log::Metadata<'_>) -> bool {
        metadata.target().starts_with("webots_fleet")
    }

    fn log(&self, record: &log::Record<'_>) {
        if self.enabled(record.metadata()) {
            LOG.lock().unwrap().push((record.level(), record.args().to_string()));
        }
    }

    fn flush(&self) {}
}

/// Keeps the log lines of this process.
pub fn keep_log() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        log::set_logger(&Keeper).unwrap();
        log::set_max_level(log::LevelFilter::Debug);
    });
}

fn log_lines() -> Vec<(log::Level, String)> {
    LOG.lock().unwrap().clone()
}

/// The log lines of a level that name this port.
pub fn logged(level: log::Level, port: u16) -> Vec<String> {
    let needle = format!(":{port}");
    log_lines()
        .into_iter()
        .filter(|(other, line)| *other == level && line.contains(&needle))
        .map(|(_, line)| line)
        .collect()
}

/// Waits until there are so many log lines of a level that name this port, and gives them back.
pub async fn wait_for_log(level: log::Level, port: u16, least: usize) -> Vec<String> {
    let come = holds_soon(async || logged(level, port).len() >= least).await;
    assert!(come, "no {least} lines of {level} about port {port} in {:#?}", log_lines());
    logged(level, port)
}
