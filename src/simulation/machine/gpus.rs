//! The NVIDIA GPUs of the machine (NVML): those that answer, and whether some are lost. A thread reads them, because their
//! driver may hang.

use std::ffi::OsStr;
use std::time::{Duration, Instant};

use nvml_wrapper::Nvml;
use nvml_wrapper::error::NvmlError;
use tokio::sync::watch;

use super::sensors::{Gpu, percent};
use crate::shared::run::permanent;

/// Interval between two readings.
const PERIOD: Duration = Duration::from_secs(1);
/// Time for which a reading is used.
const SILENCE: Duration = Duration::from_secs(10);
/// Time after which a driver that is missing, or has lost a GPU, is opened again: it may have been loaded since then.
const OPEN_AGAIN: Duration = Duration::from_secs(10);
/// The driver installs its library under this name; only the development package installs the one without version.
const LIBRARY: &str = "libnvidia-ml.so.1";

/// A reading of all GPUs.
#[derive(Debug)]
pub(super) struct GpuReading {
    /// Its time.
    pub at: Instant,
    /// The GPUs that answer.
    pub gpus: Vec<Gpu>,
    /// Number of GPUs, including those that don't answer: they may have fallen off their bus.
    pub known: usize,
}

/// Starts the thread, and returns the receiver of its last reading. The thread ends when the receiver is dropped.
pub(super) fn follow() -> std::io::Result<watch::Receiver<Option<GpuReading>>> {
    let (sender, last) = watch::channel(None);
    permanent::thread("gpus", move || read(&sender))?;
    Ok(last)
}

fn read(sender: &watch::Sender<Option<GpuReading>>) {
    let mut known = 0;
    let mut told = false;
    while !sender.is_closed() {
        let opened = Instant::now();
        match Nvml::builder().lib_path(OsStr::new(LIBRARY)).init() {
            Ok(nvml) => {
                let mut is_complete = true;
                while !sender.is_closed() && (is_complete || opened.elapsed() < OPEN_AGAIN) {
                    let count = nvml.device_count().unwrap_or(0);
                    let gpus: Vec<Gpu> = (0..count).filter_map(|index| read_one(&nvml, index).ok()).collect();
                    known = known.max(count as usize);
                    is_complete = gpus.len() == known;
                    sender.send_replace(Some(GpuReading {
                        at: Instant::now(),
                        gpus,
                        known,
                    }));
                    std::thread::sleep(PERIOD);
                }
            }
            Err(error) => {
                if !std::mem::replace(&mut told, true) {
                    log::info!("no NVIDIA GPU is read: {error}");
                }
                std::thread::sleep(OPEN_AGAIN);
            }
        }
    }
}

/// Reads one GPU. Some report no utilisation: then it is 0.
fn read_one(nvml: &Nvml, index: u32) -> Result<Gpu, NvmlError> {
    let device = nvml.device_by_index(index)?;
    let memory = device.memory_info()?;
    let utilisation = device.utilization_rates().ok();
    Ok(Gpu {
        index,
        id: device.uuid().unwrap_or_else(|_| index.to_string()),
        name: device.name().unwrap_or_else(|_| "NVIDIA GPU".to_owned()),
        compute: utilisation.as_ref().map_or(0.0, |rates| f64::from(rates.gpu)),
        memory_traffic: utilisation.map_or(0.0, |rates| f64::from(rates.memory)),
        memory: percent(memory.used, memory.total),
        memory_total: memory.total,
    })
}

/// The GPUs that answer, and the problem if others don't.
pub(super) fn current(last: Option<&GpuReading>) -> (Vec<Gpu>, Option<String>) {
    let Some(GpuReading { at, gpus, known }) = last else {
        return (Vec::new(), None);
    };
    let gpus = if at.elapsed() <= SILENCE {
        gpus.clone()
    } else {
        Vec::new()
    };
    let missing = known.saturating_sub(gpus.len());
    let problem = format!("{missing} of {known} GPUs don't answer (see Xid in the kernel's log)");
    (gpus, (missing > 0).then_some(problem))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gpus_that_are_lost_or_silent_are_told() {
        let after = |seconds, gpus| {
            let at = Instant::now().checked_sub(Duration::from_secs(seconds)).unwrap();
            let (gpus, problem) = current(Some(&GpuReading {
                at,
                gpus: vec![Gpu::default(); gpus],
                known: 2,
            }));
            (
                gpus.len(),
                problem.map_or(String::new(), |why| why.chars().take(6).collect()),
            )
        };
        assert_eq!(current(None), (vec![], None), "a machine without GPUs has lost none");
        assert_eq!(after(0, 2), (2, String::new()));
        assert_eq!(after(9, 1), (1, "1 of 2".to_owned()));
        assert_eq!(after(11, 2), (0, "2 of 2".to_owned()), "the driver hangs");
    }
}
