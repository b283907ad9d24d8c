//! Actor: takes a sample of the machine each second, keeps ten minutes of them, and writes them to a CSV file.
//!
//! One for the whole server, created at start; it never ends. It has a thread of its own, because a slow disk may block
//! it. All others read the newest [`Readings`] from a watch channel, without waiting.

use std::collections::VecDeque;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use actix::prelude::*;
use tokio::sync::watch;

use super::gpus::{self, GpuReading};
use super::sensors::{self, Gpu, Host, Machine, MachineSensor};
use super::spread::Spread;
use crate::shared::domain::Load;
use crate::shared::run::{AppError, RotatedFile, seconds_since_1970};
use crate::simulation::slots::SlotPool;

/// Interval between two samples.
const PERIOD: Duration = Duration::from_secs(1);
/// Number of samples of which the load is the mean.
const MEAN_OF: usize = 5;
/// Number of samples that are kept: ten minutes.
const KEPT: usize = 600;
/// Size from which `monitor.csv` is rotated, in bytes: with the previous file it covers most of a day.
const MAX_SIZE: u64 = 2_500_000;

/// The first line of `monitor.csv`: the columns of the original.
const HEADING: &str = "Timestamp, Webots running, Webots idle, CPU load, CPU memory, GPU load compute, GPU load memory, \
                       GPU memory, Swap, Disk, Network sent, Network received\n";

/// The newest readings of the machine, and its load.
#[derive(Debug, Clone, Default)]
pub struct Readings {
    /// The mean of the last five seconds.
    pub load: Option<Load>,
    /// The machine's name, system and hardware.
    pub host: Host,
    /// The newest reading.
    pub machine: Machine,
    /// The newest readings of the GPUs; empty without GPUs.
    pub gpus: Vec<Gpu>,
    /// What is wrong with the GPUs, if some don't answer.
    pub gpu_problem: Option<String>,
    /// The load of each of the last seconds, the oldest first.
    loads: VecDeque<Load>,
    /// The newest line of `monitor.csv`: the values of its columns.
    pub sample: Vec<String>,
    /// The samples of the last ten minutes as numbers, the oldest first.
    pub history: VecDeque<Vec<f64>>,
}

impl Readings {
    /// The names of a sample's columns.
    pub fn columns() -> &'static str {
        HEADING.trim_end()
    }
}

/// The actor.
pub struct LoadMonitor {
    slots: Arc<SlotPool>,
    sensor: MachineSensor,
    gpus: watch::Receiver<Option<GpuReading>>,
    spread: Arc<Spread>,
    csv: Option<PathBuf>,
    published: watch::Sender<Arc<Readings>>,
}

impl LoadMonitor {
    /// Creates the actor. `disk` is a directory on the monitored disk, `csv` the file for the samples. The load
    /// includes the GPU that `spread` would assign to the next simulation.
    ///
    /// # Errors
    /// When the machine can't be read, or a thread can't be started.
    pub fn new(
        slots: Arc<SlotPool>,
        disk: &Path,
        csv: Option<PathBuf>,
        spread: Arc<Spread>,
    ) -> Result<(Self, watch::Receiver<Arc<Readings>>), AppError> {
        let (sensor, gpus) = (MachineSensor::open(disk)?, gpus::follow()?);
        let (published, readings) = watch::channel(Arc::new(Readings {
            host: sensor.host(),
            ..Readings::default()
        }));
        Ok((
            Self {
                slots,
                sensor,
                gpus,
                spread,
                csv,
                published,
            },
            readings,
        ))
    }

    fn publish(&self, machine: Machine) {
        let (gpus, gpu_problem) = gpus::current(self.gpus.borrow().as_ref());
        let gpu = self.spread.next(&gpus, Instant::now()).cloned().unwrap_or_default();
        let sample = self.sample(&machine, &gpu);
        if let Some(path) = &self.csv {
            // On a full disk, only these lines are lost.
            append(path, &sample).ok();
        }
        self.published.send_modify(|readings| {
            let readings = Arc::make_mut(readings);
            match &gpu_problem {
                Some(why) if readings.gpu_problem.is_none() => log::error!("{why}; they don't count for the load"),
                None if readings.gpu_problem.is_some() => log::info!("the GPUs answer again"),
                _ => {}
            }
            push(&mut readings.loads, MEAN_OF, sensors::load(&machine, &gpu));
            push(
                &mut readings.history,
                KEPT,
                sample.iter().filter_map(|text| text.parse().ok()).collect(),
            );
            readings.load = Load::mean(readings.loads.iter().copied());
            (readings.machine, readings.gpus, readings.gpu_problem) = (machine, gpus, gpu_problem);
            readings.sample = sample;
        });
    }

    fn sample(&self, machine: &Machine, gpu: &Gpu) -> Vec<String> {
        let instances = self.slots.instances();
        vec![
            seconds_since_1970().to_string(),
            instances.running.to_string(),
            instances.idle.to_string(),
            format!("{:.1}", machine.cpu),
            format!("{:.1}", machine.memory),
            gpu.compute.to_string(),
            gpu.memory_traffic.to_string(),
            format!("{:.1}", gpu.memory),
            format!("{:.1}", machine.swap),
            format!("{:.1}", machine.disk),
            format!("{:.6}", machine.network_sent),
            format!("{:.6}", machine.network_received),
        ]
    }
}

fn append(path: &Path, sample: &[String]) -> std::io::Result<()> {
    let mut file = RotatedFile::open(path, MAX_SIZE, HEADING)?;
    file.write_all(format!("{}\n", sample.join(", ")).as_bytes())
}

/// Appends a value, and keeps the last `kept` ones.
fn push<T>(last: &mut VecDeque<T>, kept: usize, value: T) {
    if last.len() == kept {
        last.pop_front();
    }
    last.push_back(value);
}

impl Actor for LoadMonitor {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.run_interval(PERIOD, |monitor, _| {
            let machine = monitor.sensor.read();
            monitor.publish(machine);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::http::Metrics;
    use crate::simulation::ends::Ends;

    fn monitor(spread: Spread) -> (LoadMonitor, watch::Receiver<Arc<Readings>>) {
        let ends = Ends::start(PathBuf::from("/nonexistent"), String::new(), &Metrics::default()).unwrap();
        let slots = SlotPool::new(2001..=2001, 1, None, None, Duration::from_secs(10), ends);
        LoadMonitor::new(slots, Path::new("/"), None, Arc::new(spread)).unwrap()
    }

    #[test]
    fn the_load_is_a_mean_and_the_history_ten_minutes_long() {
        let (monitor, readings) = monitor(Spread::default());
        let load = || readings.borrow().load.map(Load::percent);
        assert_eq!(load(), None);
        let read = |cpu: f64| {
            monitor.publish(Machine {
                cpu,
                ..Machine::default()
            });
        };
        let table = [
            (10.0, 10.0),
            (20.0, 15.0),
            (30.0, 20.0),
            (40.0, 25.0),
            (50.0, 30.0),
            (60.0, 40.0),
            (0.0, 36.0),
        ];
        for (cpu, mean) in table {
            read(cpu);
            assert_eq!(load(), Some(mean), "after {cpu}");
        }
        for second in 0..700 {
            read(f64::from(second));
        }
        let history: Vec<f64> = readings.borrow().history.iter().map(|sample| sample[3]).collect();
        assert_eq!(history, (100..700).map(f64::from).collect::<Vec<f64>>());
        assert_eq!(PERIOD * 600, Duration::from_mins(10));
    }

    #[test]
    fn the_gpu_of_the_next_simulation_counts_for_the_load() {
        let gpu = |index, compute| Gpu {
            index,
            compute,
            ..Gpu::default()
        };
        let gpus = vec![gpu(0, 90.0), gpu(1, 60.0), gpu(2, 10.0)];
        for (displays, load) in [(0, 10.0), (2, 60.0)] {
            let (mut monitor, readings) = monitor(Spread::over(displays));
            let reading = GpuReading {
                at: Instant::now(),
                gpus: gpus.clone(),
                known: 3,
            };
            monitor.gpus = watch::channel(Some(reading)).1;
            monitor.publish(Machine::default());
            assert_eq!(readings.borrow().load.map(Load::percent), Some(load));
        }
    }
}
