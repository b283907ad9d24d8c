//! Runs a program to its end: without a shell, within limits. Dropping the future kills it.
//!
//! Also runs other work on a thread of its own, because programs that it runs may block the thread.

use std::ffi::OsString;
use std::io;
use std::path::Path;
use std::time::Duration;

use futures_util::FutureExt;
use rustix::process::{Pid, Resource, Rlimit, prlimit, setpriority_process};
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::net::unix::pipe::Receiver;
use tokio::runtime::Builder;
use tokio_util::sync::CancellationToken;

use super::lines::Lines;
use super::process_group::{ExitReason, ProcessGroup, SpawnSpec};

/// A program to run to its end, with its limits.
pub struct Run {
    /// How it is started.
    pub spec: SpawnSpec,
    /// Timeout, after which it is killed.
    pub time: Duration,
    /// Size limit of its answer, in bytes; 0: no answer, its standard output is passed on with its standard error.
    pub answer: u64,
    /// Resource limits of it and its children. They apply a moment after the start.
    pub limits: Vec<(Resource, u64)>,
    /// Its niceness.
    pub niceness: i32,
    /// Whether its start may block the calling thread, until `execve`, which takes long on a busy machine.
    pub may_block: bool,
}

/// How a program ended.
#[derive(Debug)]
pub struct Ran {
    /// Its exit code or signal.
    pub ending: ExitReason,
    /// What it printed on its standard output.
    pub answer: Vec<u8>,
}

/// Why a program has not ended by itself. The message follows the name of the program.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// It does not exist, or the system can start no more processes.
    #[error("can't be started: {0}")]
    NotStarted(#[from] io::Error),
    /// It exceeded its timeout.
    #[error("did not end within {} seconds", .0.as_secs_f64())]
    Slow(Duration),
    /// Its answer exceeds the size limit.
    #[error("has answered too much")]
    TooLong,
}

/// Size of a read in bytes, and the pause after a read that fills it, so that a program that prints without end is
/// slowed down.
const CHUNK: (usize, Duration) = (16 * 1024, Duration::from_millis(5));
/// Lines per extra pause: each line costs work, however short.
const LINES: u32 = 50;

impl Run {
    /// A program of the server's own with its arguments, in the server's environment and with this mark.
    pub fn new<A: Into<OsString>>(command: impl IntoIterator<Item = A>, mark: &Path, time: Duration) -> Self {
        let spec = SpawnSpec::new(command.into_iter().map(Into::into).collect(), mark);
        Self {
            spec,
            time,
            answer: 1 << 20,
            limits: Vec::new(),
            niceness: 0,
            may_block: false,
        }
    }

    /// The same as [`Self::run`], but blocks the calling thread.
    ///
    /// # Errors
    /// Those of `run`.
    pub fn run_blocking(mut self, told: impl FnMut(String) + Send) -> Result<Ran, RunError> {
        self.may_block = true;
        let run = || {
            let runtime = Builder::new_current_thread().enable_all().build()?;
            runtime.block_on(self.run(told))
        };
        // The calling thread may have a runtime already.
        std::thread::scope(|scope| {
            let ran = std::thread::Builder::new().spawn_scoped(scope, run)?.join();
            ran.unwrap_or_else(|_| Err(io::Error::other("its thread has panicked").into()))
        })
    }

    /// Runs it. `told` receives each line of its standard error. Dropping the future kills it and its process group.
    ///
    /// # Errors
    /// When it can't be started, or is killed because it exceeds a limit.
    pub async fn run(self, told: impl FnMut(String)) -> Result<Ran, RunError> {
        let Self {
            spec,
            time,
            answer: most,
            limits,
            niceness,
            may_block,
        } = self;
        let ((output, mut answer), (said, errors)) = (io::pipe()?, io::pipe()?);
        if most == 0 {
            answer = errors.try_clone()?;
        }
        let start = move || {
            let (group, ended) = ProcessGroup::start(&spec, answer.into(), errors.into())?;
            bound(group.leader(), &limits, niceness);
            io::Result::Ok((group, ended.boxed()))
        };
        let (_group, ended) = if may_block {
            start()?
        } else {
            actix_rt::task::spawn_blocking(start)
                .await
                .map_err(io::Error::other)??
        };
        let said = Receiver::from_owned_fd(said.into())?;
        let output = Receiver::from_owned_fd(output.into())?;
        // The pipe is closed at the limit: a program that writes more would otherwise block. A broken pipe ends the
        // answer; the exit code decides whether that is an error.
        let answer = async move {
            let mut answer = Vec::new();
            output.take(most + 1).read_to_end(&mut answer).await.ok();
            answer
        };
        let all = async { tokio::join!(answer, tell(said, told), ended) };
        let Ok((answer, (), ending)) = actix_rt::time::timeout(time, all).await else {
            return Err(RunError::Slow(time));
        };
        if answer.len() as u64 > most {
            Err(RunError::TooLong)
        } else {
            Ok(Ran { ending, answer })
        }
    }
}

/// Runs a future on a thread of the blocking pool, in a runtime of its own. On a busy machine each step of a future
/// waits for a core: here it does not wait for other futures as well. Dropping the returned future cancels the work.
///
/// # Errors
/// When there is no thread or runtime for it, or it panics.
pub async fn on_own_thread<T, F>(work: impl FnOnce() -> F + Send + 'static) -> io::Result<T>
where
    T: Send + 'static,
    F: Future<Output = T>,
{
    let dropped = CancellationToken::new();
    let _guard = dropped.clone().drop_guard();
    let run = move || {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let done = runtime.block_on(dropped.run_until_cancelled_owned(work()));
        done.ok_or_else(|| io::ErrorKind::Interrupted.into())
    };
    actix_rt::task::spawn_blocking(run).await?
}

/// Limits a program that has just been started. Its children inherit the limits.
fn bound(leader: i32, limits: &[(Resource, u64)], niceness: i32) {
    let pid = Pid::from_raw(leader);
    let limit = |(resource, most): &(Resource, u64)| {
        prlimit(
            pid,
            *resource,
            Rlimit {
                current: Some(*most),
                maximum: Some(*most),
            },
        )
        .map(drop)
    };
    let nice = if niceness == 0 {
        Ok(())
    } else {
        setpriority_process(pid, niceness)
    };
    if let Err(error) = nice.and(limits.iter().try_for_each(limit)) {
        log::warn!("process {leader} runs without its limits: {error}");
    }
}

/// Passes on each line, made printable; also lines that the program overwrites.
async fn tell(mut said: impl AsyncRead + Unpin, mut told: impl FnMut(String)) {
    let mut lines = Lines::default();
    let mut chunk = vec![0; CHUNK.0];
    while let Ok(length @ 1..) = said.read(&mut chunk).await {
        let mut pauses = u32::from(length == CHUNK.0) * LINES;
        lines.feed(chunk.get(..length).unwrap_or_default(), |line| {
            pauses += 1;
            told(line);
        });
        if pauses >= LINES {
            actix_rt::time::sleep(CHUNK.1.saturating_mul(pauses / LINES)).await;
        }
    }
    lines.end(told);
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    fn shell(script: &str, time: Duration) -> Run {
        Run::new(["bash", "-c", script], Path::new("/nowhere"), time)
    }

    const LONG: Duration = Duration::from_secs(20);

    #[actix_rt::test]
    async fn an_answer_and_lines_are_told_apart_or_together() {
        let script = "echo answer; printf 'one\\rtwo\\n' >&2; exit 3";
        let mut lines = Vec::new();
        let ran = shell(script, LONG).run(|line| lines.push(line)).await.unwrap();
        assert_eq!(
            (ran.ending, ran.answer.as_slice()),
            (ExitReason::Code(3), &b"answer\n"[..])
        );
        assert_eq!(lines, ["one", "two"]);
        lines.clear();
        let ran = Run {
            answer: 0,
            ..shell(script, LONG)
        }
        .run(|line| lines.push(line))
        .await
        .unwrap();
        assert_eq!(
            (ran.ending, lines),
            (
                ExitReason::Code(3),
                ["answer", "one", "two"].map(str::to_owned).to_vec()
            )
        );
        let ran = std::thread::spawn(move || shell(script, LONG).run_blocking(drop))
            .join()
            .unwrap();
        assert_eq!(ran.unwrap().answer, b"answer\n");
        assert!(
            shell(script, LONG).run_blocking(drop).is_ok(),
            "also where there is a runtime"
        );
    }

    #[actix_rt::test]
    async fn who_takes_too_much_is_ended() {
        let begin = Instant::now();
        let slow = shell("sleep 1000 & sleep 1000", Duration::from_millis(100))
            .run(drop)
            .await
            .unwrap_err();
        assert!(matches!(slow, RunError::Slow(_)) && begin.elapsed() < LONG, "{slow}");
        let long = Run {
            answer: 3,
            ..shell("echo long", LONG)
        }
        .run(drop)
        .await
        .unwrap_err();
        assert!(matches!(long, RunError::TooLong), "{long}");
        let endless = Run {
            answer: 3,
            ..shell("yes", LONG)
        }
        .run(drop)
        .await
        .unwrap_err();
        assert!(
            matches!(endless, RunError::TooLong) && begin.elapsed() < LONG,
            "{endless}"
        );
        let none = Run::new(["/nowhere/program"], Path::new("/"), LONG)
            .run(drop)
            .await
            .unwrap_err();
        assert!(matches!(none, RunError::NotStarted(_)), "{none}");
        let script = "until [ \"$(ulimit -f)\" -le 8 ] 2>/dev/null; do sleep 0.01; done; echo bounded";
        let bounded = Run {
            limits: vec![(Resource::Fsize, 8192)],
            ..shell(script, LONG)
        }
        .run(drop)
        .await
        .unwrap();
        assert_eq!(bounded.answer, b"bounded\n");
    }

    #[actix_rt::test]
    async fn short_lines_without_end_are_read_at_their_pace() {
        let begin = Instant::now();
        let mut number = 0;
        tell("x\n".repeat(10_000).as_bytes(), |_| number += 1).await;
        assert_eq!(number, 10_000);
        assert!(begin.elapsed() > Duration::from_millis(500), "{:?}", begin.elapsed());
    }
}
