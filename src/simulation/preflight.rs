//! Checks whether the machine has what simulations need: Webots, a display, git. `--check` prints the findings.

use std::process::Command;

use which::which;

use super::config::{IsolationSetting, SandboxNetwork, SimulationConfig};
use super::container::{self, packet_filter};
use crate::simulation::isolation::Launcher;
use crate::simulation::machine::display;
use crate::simulation::machine::sensors::{GpuReading, GpuSensor};

/// Checks everything, and returns a line for each finding: what was found; or the problem, and what to do about it. It
/// runs programs and connects to the display, so it can take some seconds.
pub fn check(config: &SimulationConfig) -> Vec<String> {
    let mut findings = if config.isolation == IsolationSetting::Container {
        vec![("docker", container::check(config))]
    } else {
        vec![("webots", webots(config)), ("display", display(config))]
    };
    if config.spreads() {
        findings.push(("GPUs", gpus(config)));
    }
    findings.push(("git", version(&["git", "--version"], "git is not there: no world can be checked out")));
    let no_lfs = "git-lfs is not there: large files of Git LFS will be missing";
    findings.push(("git-lfs", version(&["git-lfs", "--version"], no_lfs)));
    if config.xvfb && config.isolation != IsolationSetting::Container {
        findings.push(("Xvfb", xvfb()));
    }
    match Launcher::new(config) {
        Ok(launcher) => findings.extend(isolation(config, &launcher)),
        Err(error) => findings.push(("isolation", Err(format!("the server does not start: {error}")))),
    }
    let line = |(topic, result)| match result {
        Ok(found) => format!("{topic}: {found}"),
        Err(problem) => format!("warning: {topic}: {problem}"),
    };
    findings.into_iter().map(line).collect()
}

/// The findings on what worlds' programs may do.
fn isolation(config: &SimulationConfig, launcher: &Launcher) -> Vec<(&'static str, Result<String, String>)> {
    let mut findings = vec![match &launcher.shortcoming {
        Some(why) => ("isolation", Err(format!("none, worlds' programs may do whatever this user may: {why}"))),
        None => ("isolation", Ok(launcher.level.to_string())),
    }];
    let words = launcher.network_in_words().filter(|_| launcher.level == IsolationSetting::Sandbox);
    findings.extend(words.map(|words| ("network", Ok(words))));
    let is_shared = launcher.network() == Some(SandboxNetwork::Shared);
    if is_shared && !config.ports_are_public() {
        findings.push(("streams", streams(config)));
    }
    if is_shared && config.user_header.is_some() && config.trusted_proxies.trusts_loopback() {
        let why = "worlds' programs can pose as any user, because they share this machine's network, and trustedProxies \
                   contains its loopback";
        findings.push(("userHeader", Err(why.to_owned())));
    }
    findings.extend(launcher.unenforced_limits().into_iter().map(|line| ("limits", Err(line))));
    findings
}

fn webots(config: &SimulationConfig) -> Result<String, String> {
    let Some(program) = config.webots_program() else {
        return Err("neither webotsHome nor the environment variable WEBOTS_HOME is set".to_owned());
    };
    let shown = program.display();
    match nix::unistd::access(&program, nix::unistd::AccessFlags::X_OK) {
        Ok(()) if program.is_file() => Ok(shown.to_string()),
        Ok(()) | Err(nix::errno::Errno::ENOENT | nix::errno::Errno::ENOTDIR) => {
            Err(format!("there is no program {shown}; webotsHome is the folder that Webots is installed in"))
        }
        Err(error) => Err(format!("{shown} can't be run by this user: {}", error.desc())),
    }
}

fn display(config: &SimulationConfig) -> Result<String, String> {
    if config.xvfb {
        return Ok("each Webots gets a virtual display of its own (xvfb), without the graphics card".to_owned());
    }
    let source = match (&config.display, display::of_environment()) {
        _ if !config.displays_of_gpus().is_empty() => "displays names them",
        (Some(_), _) => "the configuration names it",
        (None, Some(_)) => "the environment variable DISPLAY names it",
        (None, None) => "DISPLAY is not set, and the configuration names no display",
    };
    let count = u32::try_from(config.displays_of_gpus().len()).unwrap_or(u32::MAX).max(1);
    let displays: Vec<String> = (0..count).map(|gpu| config.display_on(Some(gpu))).collect();
    match displays.iter().find_map(|display| display::check(display).err()) {
        None => {
            let verb = if displays.len() > 1 { "answer" } else { "answers" };
            Ok(format!("{} {verb} ({source})", displays.join(", ")))
        }
        Some(trouble) => Err(format!("{trouble} ({source})")),
    }
}

/// The GPUs over which simulations are spread.
fn gpus(config: &SimulationConfig) -> Result<String, String> {
    let unread = |why: &str| format!("gpus is \"spread\", but no NVIDIA GPU is read, so none is chosen: {why}");
    let sensor = GpuSensor::open().map_err(|error| unread(&error.to_string()))?;
    let GpuReading { gpus, lost } = sensor.read();
    let (count, displays) = (gpus.len() + lost, config.displays_of_gpus().len());
    if count == 0 {
        return Err(unread("NVIDIA's driver knows none"));
    }
    if (1..count).contains(&displays) {
        return Err(format!("displays names {displays} of {count} GPUs' X screens: the other GPUs get no simulation"));
    }
    if displays > count {
        return Err(format!("displays names {displays} X screens, but there are {count} GPUs"));
    }
    if lost > 0 {
        return Err(format!("{lost} of {count} are lost, and get no simulation (see Xid in the kernel's log)"));
    }
    let names: Vec<&str> = gpus.iter().map(|gpu| gpu.name.as_str()).collect();
    Ok(format!("simulations are spread over {}", names.join(", ")))
}

fn xvfb() -> Result<String, String> {
    let missing =
        "it is not there, but xvfb is true: no Webots can start. On Debian and Ubuntu the package xvfb has it";
    which("Xvfb").map(|program| program.display().to_string()).map_err(|_| missing.to_owned())
}

/// Whether others reach the ports of simulations past the relay.
fn streams(config: &SimulationConfig) -> Result<String, String> {
    let (first, last) = config.streaming_ports().into_inner();
    match packet_filter::closes_streams() {
        Some(true) => Ok("relayed; the packet filter keeps others from the ports of Webots".to_owned()),
        Some(false) => Err(format!(
            "anybody who reaches ports {first} to {last} can control simulations: Webots shares this machine's network, \
             and no packet filter closes them (table webots_streams); see docs/deployment-web-server.md"
        )),
        None => Ok(format!("relayed; the firewall has to close ports {first} to {last}, on which Webots listens")),
    }
}

/// Returns the first line that a program prints.
///
/// # Errors
/// `missing`, if there is no such program or it prints nothing.
fn version(command: &[&str], missing: &str) -> Result<String, String> {
    let Some((program, arguments)) = command.split_first() else {
        return Err(missing.to_owned());
    };
    let output = Command::new(program).args(arguments).output().map_err(|_| missing.to_owned())?;
    let text = String::from_utf8_lossy(&output.stdout);
    text.lines().next().map(str::to_owned).ok_or_else(|| missing.to_owned())
}
