//! Actor: takes a sample of the machine each second, keeps ten minutes of them, and writes them to a CSV file.
//!
//! One for the whole server, created at start; it never ends. Two threads read the machine and the GPUs, so that a
//! driver that hangs blocks nothing: readings of GPUs that are too old no longer count. All others read the newest
//! [`Readings`] from a watch channel, without waiting.

use std::collections::VecDeque;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use actix::prelude::*;
use tokio::sync::watch;

use super::gpus::Gpus;
use super::sensors::{self, Gpu, GpuReading, GpuSensor, Host, Machine, MachineSensor};
use super::spread::Spread;
use crate::shared::domain::Load;
use crate::simulation::slots::SlotPool;

/// Interval between two samples.
const PERIOD: Duration = Duration::from_secs(1);
/// Number of samples of which the load is the mean.
const MEAN_OF: usize = 5;
/// Number of samples that are kept: ten minutes.
const KEPT: usize = 600;
/// Time without all GPUs after which the driver is opened again.
const OPEN_AGAIN: Duration = Duration::from_secs(10);
/// Lines of `monitor.csv` until it is renamed to `monitor.csv.1`: a day.
const CSV_LINES: usize = 86_400;
/// A column of `monitor.csv`: its heading, and its value in a sample.
type Column = (&'static str, fn(&Sample) -> String);

/// The columns of `monitor.csv`, in the order of the original.
const COLUMNS: [Column; 12] = [
    ("Timestamp", |sample| sample.timestamp.to_string()),
    ("Webots running", |sample| sample.running.to_string()),
    ("Webots idle", |sample| sample.idle.to_string()),
    ("CPU load", |sample| format!("{:.1}", sample.machine.cpu)),
    ("CPU memory", |sample| format!("{:.1}", sample.machine.memory)),
    ("GPU load compute", |sample| sample.gpu_compute.to_string()),
    ("GPU load memory", |sample| sample.gpu_memory_traffic.to_string()),
    ("GPU memory", |sample| format!("{:.1}", sample.gpu_memory)),
    ("Swap", |sample| format!("{:.1}", sample.machine.swap)),
    ("Disk", |sample| format!("{:.1}", sample.machine.disk)),
    ("Network sent", |sample| format!("{:.6}", sample.machine.network_sent)),
    ("Network received", |sample| format!("{:.6}", sample.machine.network_received)),
];

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
    /// The GPU that counts for the load: the one that the next simulation gets.
    pub next_gpu: Option<Gpu>,
    /// What is wrong with the GPUs, if some have answered and don't any more.
    pub gpu_problem: Option<String>,
    /// The last ten minutes, the oldest first.
    pub history: VecDeque<Sample>,
}

/// One line of `monitor.csv`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Seconds since 1970.
    pub timestamp: u64,
    /// Simulations that run.
    pub running: u32,
    /// Simulations that are paused.
    pub idle: u32,
    /// The machine.
    pub machine: Machine,
    /// Compute load of the GPU that counts, in percent.
    pub gpu_compute: f64,
    /// Memory traffic of that GPU, in percent of the time.
    pub gpu_memory_traffic: f64,
    /// Memory of that GPU in use, in percent.
    pub gpu_memory: f64,
    /// The load of this second, percent.
    pub load: Load,
}

#[derive(Message)]
#[rtype(result = "()")]
struct MachineRead(Machine);

#[derive(Message)]
#[rtype(result = "()")]
struct GpusRead(GpuReading);

/// The actor.
pub struct LoadMonitor {
    slots: Arc<SlotPool>,
    published: watch::Sender<Arc<Readings>>,
    csv: Option<PathBuf>,
    csv_lines: usize,
    disk: PathBuf,
    machine: Machine,
    gpus: Gpus,
    spread: Option<Arc<Spread>>,
}

impl LoadMonitor {
    /// Creates the actor. `disk` is a folder on the disk that is watched, `csv` the file that samples are written to,
    /// `spread` chooses the GPU of the next simulation; without it the least busy one counts for the load.
    pub fn new(
        slots: Arc<SlotPool>,
        disk: &Path,
        csv: Option<PathBuf>,
        spread: Option<Arc<Spread>>,
    ) -> (Self, watch::Receiver<Arc<Readings>>) {
        let (published, readings) = watch::channel(Arc::default());
        let (machine, disk, gpus) = (Machine::default(), disk.to_owned(), Gpus::default());
        (Self { slots, published, csv, csv_lines: 0, disk, machine, gpus, spread }, readings)
    }

    fn publish(&mut self, running: u32, idle: u32) {
        let now = Instant::now();
        let (gpus, gpu_problem) = self.gpus.current(now);
        let next_gpu = match &self.spread {
            Some(spread) => spread.next(&gpus, now),
            None => sensors::least_busy(&self.machine, &gpus),
        };
        let next_gpu = next_gpu.cloned();
        let gpu = next_gpu.clone().unwrap_or_default();
        let sample = Sample {
            timestamp: SystemTime::UNIX_EPOCH.elapsed().map_or(0, |age| age.as_secs()),
            running,
            idle,
            machine: self.machine,
            gpu_compute: gpu.compute,
            gpu_memory_traffic: gpu.memory_traffic,
            gpu_memory: gpu.memory,
            load: sensors::load(&self.machine, next_gpu.as_ref()),
        };
        self.write(sample);
        self.published.send_modify(|readings| {
            let readings = Arc::make_mut(readings);
            readings.machine = self.machine;
            readings.gpus = gpus;
            readings.next_gpu = next_gpu;
            readings.gpu_problem = gpu_problem;
            if readings.history.len() == KEPT {
                readings.history.pop_front();
            }
            readings.history.push_back(sample);
            readings.load = Load::mean(readings.history.iter().rev().take(MEAN_OF).map(|sample| sample.load));
        });
    }

    fn write(&mut self, sample: Sample) {
        let Some(path) = self.csv.clone() else {
            return;
        };
        let first = self.csv_lines.is_multiple_of(CSV_LINES);
        let put_aside = first && self.csv_lines > 0;
        self.csv_lines += 1;
        // On a full disk, only these lines are lost.
        drop(actix_rt::task::spawn_blocking(move || append(&path, &sample, first, put_aside)));
    }
}

fn append(path: &Path, sample: &Sample, first: bool, put_aside: bool) -> std::io::Result<()> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    if put_aside {
        std::fs::rename(path, path.with_extension("csv.1"))?;
    }
    let mut file = std::fs::File::options().create(true).append(!first).write(true).truncate(first).open(path)?;
    if file.metadata()?.len() == 0 {
        writeln!(file, "{}", Sample::headings())?;
    }
    writeln!(file, "{}", sample.columns().join(", "))
}

impl Sample {
    /// The first line of `monitor.csv`: the headings of its columns.
    pub fn headings() -> String {
        COLUMNS.map(|(heading, _)| heading).join(", ")
    }

    /// The values of `monitor.csv`, in the order of its columns.
    pub fn columns(&self) -> Vec<String> {
        COLUMNS.iter().map(|(_, value)| value(self)).collect()
    }
}

impl Actor for LoadMonitor {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        match MachineSensor::open(&self.disk) {
            Ok(sensor) => {
                let (host, actor) = (sensor.host(), ctx.address().recipient());
                self.published.send_modify(|readings| Arc::make_mut(readings).host = host);
                on_a_thread("sensor", move || read_machine(&actor, sensor));
            }
            Err(error) => log::error!("the machine can't be read: {error}"),
        }
        let actor = ctx.address().recipient();
        on_a_thread("gpus", move || read_gpus(&actor));
    }
}

/// Runs this on a thread that the runtime does not wait for.
fn on_a_thread(name: &str, run: impl FnOnce() + Send + 'static) {
    if let Err(error) = std::thread::Builder::new().name(name.to_owned()).spawn(run) {
        log::error!("no thread can be started to read the machine: {error}");
    }
}

/// Reads the machine each second, until the actor has stopped.
fn read_machine(actor: &Recipient<MachineRead>, mut sensor: MachineSensor) {
    while actor.connected() {
        // A full mailbox drops this reading.
        actor.try_send(MachineRead(sensor.read())).ok();
        std::thread::sleep(PERIOD);
    }
}

/// Opens the driver and reads the GPUs, until the actor has stopped: both may hang. A driver that is missing, or has lost a
/// GPU, is opened again after a while: it may have been loaded since then.
fn read_gpus(actor: &Recipient<GpusRead>) {
    let (mut most, mut told) = (1, false);
    while actor.connected() {
        match GpuSensor::open() {
            Ok(sensor) => read_until_missing(actor, &sensor, &mut most),
            Err(error) => {
                if !std::mem::replace(&mut told, true) {
                    log::info!("no NVIDIA GPU is read: {error}");
                }
                std::thread::sleep(OPEN_AGAIN);
            }
        }
    }
}

/// Reads the GPUs each second until some have been missing for a while, or the actor has stopped.
fn read_until_missing(actor: &Recipient<GpusRead>, sensor: &GpuSensor, most: &mut usize) {
    let mut complete = Instant::now();
    while actor.connected() && complete.elapsed() < OPEN_AGAIN {
        let reading = sensor.read();
        *most = reading.gpus.len().max(*most);
        complete = if reading.lost == 0 && reading.gpus.len() == *most { Instant::now() } else { complete };
        actor.try_send(GpusRead(reading)).ok();
        std::thread::sleep(PERIOD);
    }
}

impl Handler<MachineRead> for LoadMonitor {
    type Result = ();

    fn handle(&mut self, MachineRead(machine): MachineRead, _: &mut Self::Context) {
        self.machine = machine;
        let instances = self.slots.instances();
        self.publish(instances.running, instances.idle);
    }
}

impl Handler<GpusRead> for LoadMonitor {
    type Result = ();

    fn handle(&mut self, GpusRead(reading): GpusRead, _: &mut Self::Context) {
        self.gpus.read(Instant::now(), reading);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared::http::Metrics;
    use crate::simulation::ends::Ends;

    fn slots() -> Arc<SlotPool> {
        let ends = Ends::start(PathBuf::from("/nonexistent"), String::new(), &Metrics::default()).unwrap();
        SlotPool::new(2001..=2001, 1, None, None, ends)
    }

    #[actix_rt::test]
    async fn the_load_is_the_mean_of_five_seconds_and_the_history_is_ten_minutes_long() {
        let (mut monitor, readings) = LoadMonitor::new(slots(), Path::new("/"), None, None);
        let load = || readings.borrow().load.map(Load::percent);
        assert_eq!(load(), None);
        let mut read = |cpu: f64| {
            monitor.machine.cpu = cpu;
            monitor.publish(0, 0);
        };
        let table = [(10.0, 10.0), (20.0, 15.0), (30.0, 20.0), (40.0, 25.0), (50.0, 30.0), (60.0, 40.0), (0.0, 36.0)];
        for (cpu, mean) in table {
            read(cpu);
            assert_eq!(load(), Some(mean), "after {cpu}");
        }
        for second in 0..700 {
            read(f64::from(second));
        }
        let history: Vec<f64> = readings.borrow().history.iter().map(|sample| sample.machine.cpu).collect();
        assert_eq!(history, (100..700).map(f64::from).collect::<Vec<f64>>());
        assert_eq!(PERIOD * 600, Duration::from_mins(10));
    }

    #[actix_rt::test]
    async fn the_gpu_of_the_next_simulation_counts_for_the_load() {
        let gpu = |index, compute| Gpu { index, compute, ..Gpu::default() };
        let gpus = [gpu(0, 90.0), gpu(1, 60.0), gpu(2, 10.0)];
        for (spread, load) in [(None, 10.0), (Some(Spread::over(0)), 10.0), (Some(Spread::over(2)), 60.0)] {
            let (mut monitor, readings) = LoadMonitor::new(slots(), Path::new("/"), None, spread.map(Arc::new));
            monitor.gpus.read(Instant::now(), GpuReading { gpus: gpus.to_vec(), lost: 0 });
            monitor.publish(0, 0);
            assert_eq!(readings.borrow().load.map(Load::percent), Some(load));
        }
    }
}
