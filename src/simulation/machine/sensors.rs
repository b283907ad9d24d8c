//! Readings of the machine (sysinfo, procfs) and of a GPU, and the load that follows from them.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use nix::sys::statvfs::statvfs;
use procfs::net::{DeviceStatus, dev_status};
use serde::Serialize;
use sysinfo::{CpuRefreshKind, MemoryRefreshKind, RefreshKind, System};

use crate::shared::domain::Load;

/// A reading of the machine.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct Machine {
    /// Percent of all cores.
    pub cpu: f64,
    /// Percent in use.
    pub memory: f64,
    /// Percent in use; 0 without swap.
    pub swap: f64,
    /// Percent in use of the disk with the cache, as `df` reports it.
    pub disk: f64,
    /// MB per second, all interfaces but the loopback.
    pub network_sent: f64,
    /// MB per second, all interfaces but the loopback.
    pub network_received: f64,
}

/// A reading of a GPU.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct Gpu {
    /// Its index in NVIDIA's tools: by its position on the bus, from 0. Lost GPUs leave a gap.
    pub index: u32,
    /// Its UUID, such as `GPU-1fa4...`: programs and Docker may count GPUs in another order.
    #[serde(skip)]
    pub id: String,
    /// Its name.
    pub name: String,
    /// Percent of the time in which a kernel ran.
    pub compute: f64,
    /// Percent of the time in which its memory was read or written.
    pub memory_traffic: f64,
    /// Percent of its memory in use.
    pub memory: f64,
    /// Size of its memory, in bytes.
    pub memory_total: u64,
}

impl Gpu {
    /// How busy it is, in percent.
    pub fn load(&self) -> f64 {
        self.compute.max(self.memory)
    }
}

/// The load of a machine: `max(CPU, (swap + memory + GPU memory) / 3, GPU compute)`, all in percent, as in the
/// original. Of several GPUs, the least busy one counts, as in the original; with `gpus: "spread"` that is the one that the
/// next simulation gets. Without GPUs, an idle one.
pub fn load(machine: &Machine, gpu: &Gpu) -> Load {
    let memories = (machine.swap + machine.memory + gpu.memory) / 3.0;
    Load::try_from(machine.cpu.max(memories).max(gpu.compute)).unwrap_or(Load::ZERO)
}

/// The machine's name, system and hardware, which do not change.
#[derive(Debug, Clone, Default, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct Host {
    /// Its host name.
    pub name: String,
    /// Operating system and version.
    pub system: String,
    /// The processor's name.
    pub cpu: String,
    /// Physical cores.
    pub cores: usize,
    /// Logical cores.
    pub threads: usize,
    /// Memory, in bytes.
    pub memory: u64,
    /// Swap, in bytes.
    pub swap: u64,
}

/// Reads the machine.
pub struct MachineSensor {
    system: System,
    /// The network interfaces by name, as of the last reading.
    interfaces: HashMap<String, DeviceStatus>,
    disk: PathBuf,
    read: Instant,
}

impl MachineSensor {
    /// Prepares readings; `disk` is a directory on the disk that is monitored.
    ///
    /// # Errors
    /// When the system does not provide the readings.
    pub fn open(disk: &Path) -> Result<Self, sysinfo::Error> {
        let kinds = RefreshKind::nothing()
            .with_cpu(CpuRefreshKind::nothing().with_usage())
            .with_memory(MemoryRefreshKind::everything());
        Ok(Self {
            system: System::new_with_specifics(kinds)?,
            interfaces: dev_status().unwrap_or_default(),
            disk: disk.to_owned(),
            read: Instant::now(),
        })
    }

    /// The machine's name, system and hardware.
    pub fn host(&self) -> Host {
        let cpu = self
            .system
            .cpus()
            .first()
            .map(|cpu| cpu.brand().trim().to_owned())
            .unwrap_or_default();
        Host {
            name: System::host_name().unwrap_or_default(),
            system: System::long_os_version().unwrap_or_default(),
            cpu,
            cores: System::physical_core_count().unwrap_or_default(),
            threads: self.system.cpus().len(),
            memory: self.system.total_memory(),
            swap: self.system.total_swap(),
        }
    }

    /// Reads everything. CPU and network are means since the last reading.
    pub fn read(&mut self) -> Machine {
        self.system.refresh_cpu_usage();
        self.system.refresh_memory();
        // This reads one file; sysinfo reads several per interface.
        let before = std::mem::replace(&mut self.interfaces, dev_status().unwrap_or_default());
        let seconds = std::mem::replace(&mut self.read, Instant::now())
            .elapsed()
            .as_secs_f64()
            .max(0.001);
        let passed = |bytes: fn(&DeviceStatus) -> u64| -> u64 {
            let outside = self.interfaces.values().filter(|one| one.name != "lo");
            outside
                .filter_map(|one| Some(bytes(one).saturating_sub(bytes(before.get(&one.name)?))))
                .sum()
        };
        let sent = passed(|one| one.sent_bytes);
        let received = passed(|one| one.recv_bytes);
        Machine {
            cpu: f64::from(self.system.global_cpu_usage()),
            memory: percent(self.system.used_memory(), self.system.total_memory()),
            swap: percent(self.system.used_swap(), self.system.total_swap()),
            disk: disk_use(&self.disk),
            network_sent: megabytes(sent) / seconds,
            network_received: megabytes(received) / seconds,
        }
    }
}

/// Percent in use of a directory's disk, as `df` reports it: of the space for users, without the blocks that are
/// reserved for root. 0 if the directory does not exist.
fn disk_use(folder: &Path) -> f64 {
    statvfs(folder).map_or(0.0, |disk| {
        let used = disk.blocks().saturating_sub(disk.blocks_free());
        percent(used, used.saturating_add(disk.blocks_available()))
    })
}

#[expect(
    clippy::cast_precision_loss,
    reason = "a percentage needs no more digits than f64 has"
)]
pub(super) fn percent(part: u64, whole: u64) -> f64 {
    if whole == 0 {
        0.0
    } else {
        100.0 * part as f64 / whole as f64
    }
}

#[expect(clippy::cast_precision_loss, reason = "a rate needs no more digits than f64 has")]
fn megabytes(bytes: u64) -> f64 {
    bytes as f64 / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disk_use_is_what_df_tells() {
        let output = std::process::Command::new("df")
            .args(["--output=pcent", "/tmp"])
            .output()
            .unwrap();
        let told = String::from_utf8(output.stdout).unwrap();
        let told: f64 = told
            .lines()
            .nth(1)
            .unwrap()
            .trim()
            .trim_end_matches('%')
            .parse()
            .unwrap();
        let own = disk_use(Path::new("/tmp"));
        // df rounds up, and other programs write in between.
        assert!((told - 1.5..=told + 0.5).contains(&own), "{own} where df says {told}");
    }

    #[test]
    fn the_load_is_that_of_the_busiest_part() {
        let machine = |cpu, memory, swap| Machine {
            cpu,
            memory,
            swap,
            ..Machine::default()
        };
        let gpu = |compute, memory| Gpu {
            compute,
            memory,
            ..Gpu::default()
        };
        let table = [
            (machine(20.0, 30.0, 0.0), gpu(0.0, 0.0), 20.0, "the CPU"),
            (machine(5.0, 60.0, 0.0), gpu(0.0, 0.0), 20.0, "a third of the memory"),
            (
                machine(5.0, 90.0, 60.0),
                gpu(10.0, 90.0),
                80.0,
                "memories full together",
            ),
            (machine(5.0, 30.0, 0.0), gpu(70.0, 0.0), 70.0, "the GPU"),
        ];
        for (machine, gpu, expected, why) in table {
            let load = load(&machine, &gpu);
            assert!((load.percent() - expected).abs() < 1e-9, "{why}: {load}");
        }
    }
}
