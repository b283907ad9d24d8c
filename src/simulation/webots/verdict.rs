//! The verdict on how a simulation has ended, from what is known of its Webots. Pure.

use super::launched::End;
use crate::simulation::container::Cause;
use crate::simulation::ends::EndReason;
use crate::simulation::process::ExitReason;

/// The kind of an end, and the reason as text. `stopped` is the reason for which Webots was stopped, `was_ready`
/// whether it had listened.
pub fn verdict(stopped: Option<(EndReason, String)>, end: &End, was_ready: bool) -> (EndReason, String) {
    if let Some(stopped) = stopped {
        return stopped;
    }
    let kind = match (end.cause, end.reason) {
        (Some(cause), _) if cause.is_own() => EndReason::Fault,
        (Some(_), _) => EndReason::Limit,
        (None, ExitReason::Code(0)) => EndReason::Finished,
        (None, _) if was_ready => EndReason::Crashed,
        (None, _) => EndReason::NoWebots,
    };
    let why = match end.cause {
        Some(cause) => words(cause).to_owned(),
        None if kind == EndReason::Finished => "Webots has ended".to_owned(),
        None => format!("Webots {}", end.reason),
    };
    (kind, why)
}

/// The cause of a container's end, as text for the client.
fn words(cause: Cause) -> &'static str {
    match cause {
        Cause::OutOfMemory => "The simulation has taken more memory than it may (limits.memory)",
        Cause::NotStarted => "Docker can't start the simulation's container on this simulation server",
        Cause::Docker => "Docker has stopped on this simulation server, and all simulations in it have ended",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::ends::Taken;

    #[test]
    fn each_end_has_its_kind() {
        let end = |reason, cause| End { reason, cause, taken: Taken::default() };
        let (ok, killed) = (ExitReason::Code(0), ExitReason::Signal(9));
        for (end, was_ready, kind, words) in [
            (end(ok, None), true, EndReason::Finished, "Webots has ended"),
            (end(killed, None), true, EndReason::Crashed, "Webots was ended by the signal SIGKILL"),
            (end(ExitReason::Code(3), None), false, EndReason::NoWebots, "Webots ended with exit code 3"),
            (end(ExitReason::NotStarted, None), false, EndReason::NoWebots, "Webots could not be started"),
            (end(killed, Some(Cause::OutOfMemory)), true, EndReason::Limit, super::words(Cause::OutOfMemory)),
            (end(ok, Some(Cause::Docker)), true, EndReason::Fault, super::words(Cause::Docker)),
        ] {
            assert_eq!(verdict(None, &end, was_ready), (kind, words.to_owned()), "{end:?}");
            let stopped = (EndReason::Hung, "It was silent".to_owned());
            assert_eq!(verdict(Some(stopped.clone()), &end, was_ready), stopped);
        }
    }
}
