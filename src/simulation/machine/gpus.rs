//! The GPUs of the machine: those that answer, and whether some are lost. Pure; the caller passes the time.

use std::time::{Duration, Instant};

use super::sensors::{Gpu, GpuReading};

/// Time for which a reading is used, and timeout of silent GPUs.
const SILENCE: Duration = Duration::from_secs(10);

/// What is known of the GPUs.
#[derive(Debug, Default)]
pub(super) struct Gpus {
    /// The last reading, and its time.
    reading: Option<(Instant, GpuReading)>,
    /// The largest number that have answered at once, and when that many last did.
    answered: Option<(Instant, usize)>,
    problem: Option<String>,
}

impl Gpus {
    /// Records a reading.
    pub(super) fn read(&mut self, now: Instant, reading: GpuReading) {
        if self.answered.is_none() && !reading.gpus.is_empty() {
            let names: Vec<&str> = reading.gpus.iter().map(|gpu| gpu.name.as_str()).collect();
            log::info!("GPUs: {}", names.join(", "));
        }
        if reading.gpus.len() >= self.answered.map_or(1, |(_, most)| most) {
            self.answered = Some((now, reading.gpus.len()));
        }
        self.reading = Some((now, reading));
    }

    /// Returns the GPUs that answer, and the problem if some have answered before and don't any more. Logs changes.
    pub(super) fn current(&mut self, now: Instant) -> (Vec<Gpu>, Option<String>) {
        let is_recent = |at: Instant| now.saturating_duration_since(at) <= SILENCE;
        let reading = self.reading.clone().filter(|(at, _)| is_recent(*at));
        let GpuReading { gpus, lost } = reading.map(|(_, reading)| reading).unwrap_or_default();
        let problem = match self.answered {
            _ if lost > 0 => Some(format!(
                "NVIDIA's driver has lost {lost} of {} GPUs (see Xid in the kernel's log)",
                lost + gpus.len()
            )),
            Some((at, count)) if !is_recent(at) && gpus.is_empty() => {
                Some(format!("no GPU answers any more, of {count} that did"))
            }
            Some((at, count)) if !is_recent(at) => {
                Some(format!("{} of {count} GPUs don't answer any more", count.saturating_sub(gpus.len())))
            }
            _ => None,
        };
        match &problem {
            Some(why) if self.problem.is_none() => {
                log::error!("{why}; those that don't answer don't count for the load");
            }
            None if self.problem.is_some() => log::info!("the GPUs answer again"),
            _ => {}
        }
        self.problem.clone_from(&problem);
        (gpus, problem)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reading(gpus: usize, lost: usize) -> GpuReading {
        GpuReading { gpus: vec![Gpu::default(); gpus], lost }
    }

    #[test]
    fn gpus_that_were_seen_and_are_gone_are_told() {
        let begin = Instant::now();
        let at = |second| begin + Duration::from_secs(second);
        let mut gpus = Gpus::default();
        assert_eq!(gpus.current(at(100)), (vec![], None), "a machine without GPUs has lost none");
        gpus.read(at(0), reading(2, 0));
        assert_eq!((gpus.current(at(10)).0.len(), gpus.current(at(10)).1), (2, None));
        for second in 11..=20 {
            gpus.read(at(second), reading(0, 0));
        }
        let (left, why) = gpus.current(at(20));
        assert_eq!((left.len(), why.as_deref()), (0, Some("no GPU answers any more, of 2 that did")));
        gpus.read(at(21), reading(2, 0));
        assert_eq!(gpus.current(at(21)).1, None);
        // The driver hangs.
        assert_eq!(gpus.current(at(31)).0.len(), 2);
        let (left, why) = gpus.current(at(32));
        assert!(left.is_empty() && why.is_some());
    }
}
