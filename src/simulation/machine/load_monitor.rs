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
use crate::shared::domain::{Instances, Load};
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

/// A column of `monitor.csv`, of `/history` and of the charts.
struct Column {
    heading: &'static str,
    /// Number of decimal places that are kept.
    decimals: u8,
    value: fn(&Sample) -> f64,
}

/// What one line of `monitor.csv` is taken from.
struct Sample<'a> {
    /// In seconds since 1970.
    at: u64,
    instances: Instances,
    machine: &'a Machine,
    /// The GPU that the next simulation would get.
    gpu: &'a Gpu,
}

/// The columns: those of the original, then others.
const COLUMNS: [Column; 12] = [
    column("Timestamp", 0, |sample| whole(sample.at)),
    column("Webots running", 0, |sample| sample.instances.running.into()),
    column("Webots idle", 0, |sample| sample.instances.idle.into()),
    column("CPU load", 1, |sample| sample.machine.cpu),
    column("CPU memory", 1, |sample| sample.machine.memory),
    column("GPU load compute", 0, |sample| sample.gpu.compute),
    column("GPU load memory", 0, |sample| sample.gpu.memory_traffic),
    column("GPU memory", 1, |sample| sample.gpu.memory),
    column("Swap", 1, |sample| sample.machine.swap),
    column("Disk", 1, |sample| sample.machine.disk),
    column("Network sent", 6, |sample| sample.machine.network_sent),
    column("Network received", 6, |sample| sample.machine.network_received),
];

const fn column(heading: &'static str, decimals: u8, value: fn(&Sample) -> f64) -> Column {
    Column {
        heading,
        decimals,
        value,
    }
}

/// A number of seconds since 1970, exact until the year 2106.
fn whole(seconds: u64) -> f64 {
    u32::try_from(seconds).unwrap_or(u32::MAX).into()
}

impl Column {
    fn rounded(&self, sample: &Sample) -> f64 {
        let scale = 10_f64.powi(self.decimals.into());
        ((self.value)(sample) * scale).round() / scale
    }
}

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
    /// The values of the columns of `monitor.csv` in the last ten minutes, the oldest first.
    pub history: VecDeque<Vec<f64>>,
}

impl Readings {
    /// The headings of the columns of a sample, as in the first line of `monitor.csv`.
    pub fn columns() -> String {
        COLUMNS.map(|column| column.heading).join(", ")
    }

    /// The newest sample; empty before the first.
    pub fn sample(&self) -> Vec<f64> {
        self.history.back().cloned().unwrap_or_default()
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
        let sensor = MachineSensor::open(disk)?;
        let gpus = gpus::follow()?;
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
        let sample = Sample {
            at: seconds_since_1970(),
            instances: self.slots.instances(),
            machine: &machine,
            gpu: &gpu,
        };
        let values = COLUMNS.map(|column| column.rounded(&sample)).to_vec();
        // Once another process has the port, that writes them.
        if let Some(path) = &self.csv
            && !self.slots.is_superseded()
        {
            // On a full disk, only these lines are lost.
            append(path, &values).ok();
        }
        self.published.send_modify(|readings| {
            let readings = Arc::make_mut(readings);
            match &gpu_problem {
                Some(why) if readings.gpu_problem.is_none() => log::error!("{why}; they don't count for the load"),
                None if readings.gpu_problem.is_some() => log::info!("the GPUs answer again"),
                _ => {}
            }
            push(&mut readings.loads, MEAN_OF, sensors::load(&machine, &gpu));
            push(&mut readings.history, KEPT, values);
            readings.load = Load::mean(readings.loads.iter().copied());
            readings.machine = machine;
            readings.gpus = gpus;
            readings.gpu_problem = gpu_problem;
        });
    }
}

fn append(path: &Path, values: &[f64]) -> std::io::Result<()> {
    let mut file = RotatedFile::open(path, MAX_SIZE, Readings::columns() + "\n")?;
    let texts = values
        .iter()
        .zip(&COLUMNS)
        .map(|(value, column)| format!("{value:.0$}", usize::from(column.decimals)));
    file.write_all((texts.collect::<Vec<_>>().join(", ") + "\n").as_bytes())
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
        let ends = Ends::start(PathBuf::from("/nonexistent"), String::new(), 12, &Metrics::default()).unwrap();
        let slots = SlotPool::new(2001..=2001, 1, None, None, Duration::MAX, Duration::from_secs(10), ends);
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
