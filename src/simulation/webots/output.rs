//! The output of a simulator: some lines show its state, all others are written to a log.
//!
//! A thread per simulator reads its output, no faster than its limit, so that neither a flood of it nor a slow disk delays
//! others: a simulator that prints faster than this thread reads blocks in its own write.

use std::collections::VecDeque;
use std::io::{PipeReader, Read, Write};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use actix::prelude::*;
use parking_lot::Mutex;
use tokio::sync::oneshot;

use crate::shared::run::RotatedFile;
use crate::simulation::container::RUNS;
use crate::simulation::process::Lines;

/// The state that a line of Webots' output shows.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
#[rtype(result = "()")]
pub enum OutputEvent {
    /// [`RUNS`]: its container runs.
    ContainerRuns,
    /// `.`: the heartbeat.
    Heartbeat,
    /// `pause`: the simulation is paused.
    Paused,
    /// `real-time`, `fast`, `step`: the simulation runs.
    Running,
    /// `reset`: the simulation was reset to its start.
    Reset,
}

/// The last lines of an output, the latest first.
#[derive(Debug, Clone, Default)]
pub struct Tail(Arc<Mutex<VecDeque<String>>>);

/// Number of lines that are kept.
const LINES: usize = 20;
/// Size of a read, in bytes.
const CHUNK: usize = 8 * 1024;
/// Cost of a line, and of a read, besides its length, in bytes: each line is parsed, kept and written separately, and a
/// program that writes byte by byte causes a read for each.
const STEP: u64 = 200;
/// Pause after an event. Webots prints its state every few seconds; a program that floods it is blocked.
const AFTER_EVENT: Duration = Duration::from_millis(20);

impl OutputEvent {
    /// The event of a line; `None` for the simulation's own lines.
    pub fn parse(line: &str) -> Option<Self> {
        match line {
            RUNS => Some(Self::ContainerRuns),
            "." => Some(Self::Heartbeat),
            "pause" => Some(Self::Paused),
            "real-time" | "fast" | "step" => Some(Self::Running),
            "reset" => Some(Self::Reset),
            _ => None,
        }
    }
}

impl Tail {
    /// The lines as one text, for the client: Webots usually prints there what is wrong. The path of the project is
    /// removed.
    pub fn text(&self, project: &Path) -> String {
        let lines = self.0.lock();
        let lines: Vec<&str> = lines.iter().rev().map(String::as_str).collect();
        lines.join(" | ").replace(&format!("{}/", project.display()), "")
    }

    fn push(&self, line: String) {
        let mut lines = self.0.lock();
        lines.push_front(line);
        lines.truncate(LINES);
    }
}

/// Reads an output until its end, at this many bytes per second at most: events are sent to `events`, other lines are
/// written to the file and to the tail. Returns the tail, and a receiver that is notified at the end.
///
/// # Errors
/// When the thread can't be created.
pub fn follow(
    mut output: PipeReader,
    limit: u64,
    mut file: Option<RotatedFile>,
    events: Recipient<OutputEvent>,
) -> std::io::Result<(Tail, oneshot::Receiver<()>)> {
    let tail = Tail::default();
    let kept = tail.clone();
    let (end, ended) = oneshot::channel();
    std::thread::Builder::new().name("output".to_owned()).spawn(move || {
        let mut take = |line: String| {
            if let Some(event) = OutputEvent::parse(&line) {
                events.do_send(event);
                std::thread::sleep(AFTER_EVENT);
            } else {
                if let Some(file) = &mut file {
                    // On a full disk the lines are lost, and the simulation continues.
                    file.write_all(format!("{line}\n").as_bytes()).ok();
                }
                kept.push(line);
            }
        };
        let mut lines = Lines::default();
        let mut chunk = vec![0; CHUNK];
        while let Ok(length @ 1..) = output.read(&mut chunk) {
            let mut cost = STEP + u64::try_from(length).unwrap_or_default();
            lines.feed(chunk.get(..length).unwrap_or_default(), |line| {
                cost += STEP;
                take(line);
            });
            std::thread::sleep(Duration::from_micros(1_000_000 * cost / limit.max(1)));
        }
        lines.end(take);
        // The receiver may have been dropped.
        end.send(()).ok();
    })?;
    Ok((tail, ended))
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    struct Nobody;

    impl Actor for Nobody {
        type Context = Context<Self>;
    }

    impl Handler<OutputEvent> for Nobody {
        type Result = ();

        fn handle(&mut self, _: OutputEvent, _: &mut Self::Context) {}
    }

    #[actix_rt::test]
    async fn a_large_limit_is_one_too() {
        let (reader, mut writer) = std::io::pipe().unwrap();
        let begin = Instant::now();
        let (_, ended) = follow(reader, 16 << 20, None, Nobody.start().recipient()).unwrap();
        std::thread::spawn(move || writer.write_all(&vec![b'x'; 4 << 20]));
        ended.await.unwrap();
        assert!(begin.elapsed() > Duration::from_millis(240), "{:?}", begin.elapsed());
    }

    #[test]
    fn only_whole_lines_are_events() {
        let table = [
            (".", Some(OutputEvent::Heartbeat)),
            ("pause", Some(OutputEvent::Paused)),
            ("step", Some(OutputEvent::Running)),
        ];
        for (line, event) in table {
            assert_eq!(OutputEvent::parse(line), event);
        }
        for line in ["..", "", "paused", "real-time:", "open", "INFO: pause"] {
            assert_eq!(OutputEvent::parse(line), None, "{line:?}");
        }
    }
}
