//! Simulation time: its speed relative to wall time, and when it pauses by itself. Pure; the simulation passes the
//! elapsed wall time.

use std::time::Duration;

use clap::ValueEnum;

/// Speed of `fast` as a multiple of real time. Webots runs as fast as it can; here a limit lets many demo simulators
/// share a machine.
const FAST_SPEED: f64 = 16.0;
/// Longest wall time between two calls that counts: a suspended process does not catch up.
const LONGEST_SPAN: Duration = Duration::from_secs(1);

/// Whether and how time runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Mode {
    /// Time stands still
    #[value(alias = "stop")]
    Pause,
    /// One second of simulation per second
    #[value(name = "realtime")]
    RealTime,
    /// Faster than real time
    #[value(alias = "run")]
    Fast,
}

/// The effect of a span of wall time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Progress {
    /// Not enough time for a step has passed.
    None,
    /// One or more steps were made.
    Advanced,
    /// Steps were made up to the timeout; the clock is paused.
    TimedOut,
}

/// The simulation's time.
#[derive(Debug)]
pub(crate) struct Clock {
    mode: Mode,
    /// Length of a step, in milliseconds.
    step: f64,
    /// Simulation time, in milliseconds.
    now: f64,
    /// Simulation time at which to pause; infinite for never.
    pause_at: f64,
    /// Simulation time that has passed since the last whole step, in milliseconds.
    remainder: f64,
}

impl Clock {
    /// A clock at time 0, whose steps are `step` milliseconds long.
    pub(crate) fn new(mode: Mode, step: f64) -> Self {
        Self {
            mode,
            step,
            now: 0.0,
            pause_at: f64::INFINITY,
            remainder: 0.0,
        }
    }

    /// Simulation time, in milliseconds.
    pub(crate) fn now(&self) -> f64 {
        self.now
    }

    /// Whether and how time runs.
    pub(crate) fn mode(&self) -> Mode {
        self.mode
    }

    /// Changes the mode and nothing else.
    pub(crate) fn set_mode(&mut self, mode: Mode) {
        self.mode = mode;
        self.remainder = 0.0;
    }

    /// Pauses once `timeout` milliseconds of simulation time have passed.
    pub(crate) fn set_timeout(&mut self, timeout: f64) {
        self.pause_at = self.now + timeout;
    }

    /// Sets the time to 0, in the same mode and without a timeout.
    pub(crate) fn reset(&mut self) {
        *self = Self::new(self.mode, self.step);
    }

    /// Sets the time to 0 for another world, in the same mode and with the same time to the timeout.
    pub(crate) fn restart(&mut self, step: f64) {
        let remaining = (self.pause_at - self.now).max(0.0);
        *self = Self {
            pause_at: remaining,
            ..Self::new(self.mode, step)
        };
    }

    /// Makes one step, in any mode.
    pub(crate) fn step(&mut self) {
        self.now += self.step;
    }

    /// Makes the steps for `elapsed` wall time. Pauses after the timeout only if `has_clients`.
    pub(crate) fn advance(&mut self, elapsed: Duration, has_clients: bool) -> Progress {
        let speed = match self.mode {
            Mode::Pause => return Progress::None,
            Mode::RealTime => 1.0,
            Mode::Fast => FAST_SPEED,
        };
        self.remainder += elapsed.min(LONGEST_SPAN).as_secs_f64() * 1000.0 * speed;
        // rounded, so that a timer that fires a little early does not skip a frame
        let steps = (self.remainder / self.step).round();
        if steps < 1.0 {
            return Progress::None;
        }
        self.remainder -= steps * self.step;
        let steps_left = ((self.pause_at - self.now) / self.step).ceil().max(1.0);
        if steps < steps_left || !has_clients {
            self.now += steps * self.step;
            return Progress::Advanced;
        }
        self.now += steps_left * self.step;
        self.pause_at = f64::INFINITY;
        self.set_mode(Mode::Pause);
        Progress::TimedOut
    }
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "whole numbers of milliseconds are exact")]
mod tests {
    use super::*;

    #[test]
    fn real_time_makes_whole_steps_and_keeps_the_rest() {
        let mut clock = Clock::new(Mode::RealTime, 32.0);
        assert_eq!(clock.advance(Duration::from_millis(10), true), Progress::None);
        assert_eq!(clock.advance(Duration::from_millis(10), true), Progress::Advanced);
        assert_eq!(clock.now(), 32.0);
        for _ in 0..98 {
            clock.advance(Duration::from_millis(10), true);
        }
        assert_eq!(clock.now(), 992.0, "1000 ms of wall time");
    }

    #[test]
    fn fast_is_faster_by_a_fixed_factor() {
        let mut clock = Clock::new(Mode::Fast, 10.0);
        clock.advance(Duration::from_millis(100), true);
        assert_eq!(clock.now(), 1600.0);
    }

    #[test]
    fn the_timeout_pauses_at_the_first_step_that_reaches_it() {
        for (timeout, expected) in [(0.0, 32.0), (32.0, 32.0), (33.0, 64.0), (100.0, 128.0)] {
            let mut clock = Clock::new(Mode::Fast, 32.0);
            clock.set_timeout(timeout);
            assert_eq!(
                clock.advance(Duration::from_millis(100), true),
                Progress::TimedOut,
                "{timeout}"
            );
            assert_eq!((clock.now(), clock.mode()), (expected, Mode::Pause), "{timeout}");
            clock.set_mode(Mode::Fast);
            assert_eq!(
                clock.advance(Duration::from_millis(100), true),
                Progress::Advanced,
                "it pauses only once"
            );
        }
    }

    #[test]
    fn without_clients_it_pauses_once_one_is_there() {
        let mut clock = Clock::new(Mode::RealTime, 10.0);
        clock.set_timeout(20.0);
        assert_eq!(clock.advance(Duration::from_millis(100), false), Progress::Advanced);
        assert_eq!(clock.now(), 100.0);
        assert_eq!(clock.advance(Duration::from_millis(10), true), Progress::TimedOut);
    }

    #[test]
    fn a_process_that_was_stopped_for_long_does_not_catch_up() {
        let mut clock = Clock::new(Mode::RealTime, 10.0);
        clock.advance(Duration::from_hours(1), true);
        assert_eq!(clock.now(), 1000.0);
    }
}
