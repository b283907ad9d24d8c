//! The output of a simulator: some lines show its state, all others are written to a log.
//!
//! A thread per simulator reads its output, so that neither a flood of it nor a slow disk delays others: a simulator
//! that prints faster than this thread reads blocks in its own write.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use parking_lot::Mutex;
use tokio::sync::oneshot;

use super::paced_reader::PacedReader;
use crate::shared::run::RotatedFile;
use crate::shared::text::one_line;
use crate::simulation::container::RUNS;

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

/// The last lines of an output.
#[derive(Debug, Clone, Default)]
pub struct Tail(Arc<Mutex<VecDeque<String>>>);

/// Number of lines that are kept.
const LINES: usize = 20;
/// Bytes that are kept of a line; the rest, up to the next line break, is dropped.
const LINE_SIZE: usize = 1000;
/// Size of a read, in bytes. The next read waits for its pace.
const CHUNK: usize = 8 * 1024;
/// Shortest time between two events. Webots prints its state every few seconds; a program that floods it is blocked.
const BETWEEN_EVENTS: Duration = Duration::from_millis(20);

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
    /// The lines as the end of a sentence, for the client: Webots usually prints there what is wrong. The path of the
    /// project is removed.
    pub fn last_words(&self, project: &Path) -> String {
        let lines = self.0.lock();
        if lines.is_empty() {
            return ".".to_owned();
        }
        let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
        format!(". Its last output: {}", lines.join(" | ").replace(&format!("{}/", project.display()), ""))
    }

    fn push(&self, line: String) {
        let mut lines = self.0.lock();
        if lines.len() == LINES {
            lines.pop_front();
        }
        lines.push_back(line);
    }
}

/// Reads an output until its end: events are sent to `events`, other lines are written to the file and to the tail.
/// Returns the tail, and a receiver that is notified at the end.
///
/// # Errors
/// When the thread can't be created.
pub fn follow(
    output: PacedReader,
    mut file: Option<RotatedFile>,
    events: Recipient<OutputEvent>,
) -> std::io::Result<(Tail, oneshot::Receiver<()>)> {
    let tail = Tail::default();
    let kept = tail.clone();
    let (end, ended) = oneshot::channel();
    std::thread::Builder::new().name("output".to_owned()).spawn(move || {
        let mut reader = BufReader::with_capacity(CHUNK, output);
        let mut told = None;
        while let Some(line) = next_line(&mut reader) {
            if let Some(event) = OutputEvent::parse(&line) {
                if let Some(told) = told {
                    std::thread::sleep(BETWEEN_EVENTS.saturating_sub(Instant::elapsed(&told)));
                }
                deliver(&events, event);
                told = Some(Instant::now());
            } else {
                if let Some(file) = &mut file {
                    // On a full disk the lines are lost, and the simulation continues.
                    file.write_all(format!("{line}\n").as_bytes()).ok();
                }
                kept.push(line);
            }
        }
        // The receiver may have been dropped.
        end.send(()).ok();
    })?;
    Ok((tail, ended))
}

/// Sends an event. If the actor can't keep up, the simulator blocks, and the mailbox does not grow.
fn deliver(events: &Recipient<OutputEvent>, event: OutputEvent) {
    while let Err(SendError::Full(_)) = events.try_send(event) {
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The next line, cut to [`LINE_SIZE`] and made printable; `None` at the end of the output.
fn next_line(reader: &mut impl BufRead) -> Option<String> {
    let mut line = Vec::new();
    loop {
        let chunk = match reader.fill_buf() {
            Ok([]) => return (!line.is_empty()).then(|| printable(&line)),
            Ok(chunk) => chunk,
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(_) => return None,
        };
        let end = chunk.iter().position(|byte| *byte == b'\n');
        let text = chunk.get(..end.unwrap_or(chunk.len())).unwrap_or_default();
        let room = LINE_SIZE.saturating_sub(line.len()).min(text.len());
        line.extend_from_slice(text.get(..room).unwrap_or_default());
        let used = end.map_or(chunk.len(), |end| end + 1);
        reader.consume(used);
        if end.is_some() {
            return Some(printable(&line));
        }
    }
}

fn printable(line: &[u8]) -> String {
    one_line(String::from_utf8_lossy(line).trim_end())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn lines_are_cut_and_made_printable() {
        let flood = "x".repeat(1_000_000);
        let text = format!(".\n{flood}\npause\r\n\u{1b}[31mred\n");
        let mut bytes = text.into_bytes();
        bytes.extend_from_slice(b"\xff\xfe no text\nlast");
        let mut reader = BufReader::with_capacity(16, bytes.as_slice());
        let lines: Vec<String> = std::iter::from_fn(|| next_line(&mut reader)).collect();
        let kept = "x".repeat(LINE_SIZE);
        assert_eq!(lines, [".", &kept, "pause", " [31mred", "\u{fffd}\u{fffd} no text", "last"]);
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

    proptest! {
        #[test]
        fn every_line_is_short_and_printable_whatever_is_printed(
            bytes in prop::collection::vec(prop_oneof![3 => any::<u8>(), 1 => Just(b'\n'), 1 => Just(0x1b)], 0..4000),
            buffer in 1_usize..64,
        ) {
            let mut reader = BufReader::with_capacity(buffer, bytes.as_slice());
            let lines: Vec<String> = std::iter::from_fn(|| next_line(&mut reader)).collect();
            for line in &lines {
                prop_assert!(!line.chars().any(char::is_control) && line.chars().count() <= LINE_SIZE, "{line:?}");
            }
            let breaks = bytes.split(|byte| *byte == b'\n').count();
            prop_assert!(lines.len() <= breaks, "{} lines of {breaks}", lines.len());
        }
    }
}
