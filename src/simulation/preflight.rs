//! Checks whether the machine has what simulations need: Webots, a display, git. `--check` prints the findings.

use std::process::Command;

use super::config::SimulationConfig;
use super::container::{self, packet_filter};
use super::readiness;
use crate::simulation::isolation::{IsolationLevel, Launcher, Network};
use crate::simulation::machine::display;

/// Checks everything, and returns a line for each finding: what was found; or the problem, and what to do about it. It
/// runs programs and connects to the display, so it can take some seconds.
pub fn check(config: &SimulationConfig) -> Vec<String> {
    let mut findings = if config.docker {
        vec![("docker", container::check(config))]
    } else {
        let webots = readiness::webots_program(config).map(|program| program.display().to_string());
        vec![("webots", webots), ("display", display(config))]
    };
    findings.push(("git", version("git", "no world can be checked out")));
    findings.push(("git-lfs", version("git-lfs", "large files of Git LFS will be missing")));
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

/// The findings on what worlds' programs can access.
fn isolation(config: &SimulationConfig, launcher: &Launcher) -> Vec<(&'static str, Result<String, String>)> {
    let mut findings = vec![match launcher.shortcoming() {
        Some(why) => (
            "isolation",
            Err(format!("none, worlds' programs may do whatever this user may: {why}")),
        ),
        None => ("isolation", Ok(launcher.level().to_string())),
    }];
    let words = launcher
        .network_in_words()
        .filter(|_| launcher.level() == IsolationLevel::Sandbox);
    findings.extend(words.map(|words| ("network", Ok(words))));
    findings.extend(launcher.exposed_files(config).map(|words| ("streams", Err(words))));
    let is_shared = launcher.network() == Some(Network::Shared);
    if is_shared && !config.ports_are_public() {
        findings.push(("streams", streams(config)));
    }
    if is_shared && config.user_header.is_some() && config.trusted_proxies.trusts_loopback() {
        let why = "worlds' programs can pose as any user, because they share this machine's network, and trustedProxies \
                   contains its loopback";
        findings.push(("userHeader", Err(why.to_owned())));
    }
    findings.extend(
        launcher
            .unenforced_limits()
            .into_iter()
            .map(|line| ("limits", Err(line))),
    );
    findings
}

fn display(config: &SimulationConfig) -> Result<String, String> {
    if config.xvfb {
        let kind = "each Webots gets a virtual display of its own (xvfb), without the graphics card";
        return readiness::find_xvfb().map(|_| kind.to_owned());
    }
    let displays = config.all_displays();
    displays.iter().try_for_each(|display| display::check(display))?;
    Ok(format!("an X server answers at {}", displays.join(", ")))
}

/// Whether others can bypass the relay and reach the ports of simulations.
fn streams(config: &SimulationConfig) -> Result<String, String> {
    let (first, last) = config.streaming_ports().into_inner();
    match packet_filter::closes_streams() {
        Some(true) => Ok("relayed; the packet filter keeps others from the ports of Webots".to_owned()),
        Some(false) => Err(format!(
            "anybody who reaches ports {first} to {last} can control simulations: Webots shares this machine's network, \
             and no packet filter closes them (table webots_streams); see docs/deployment-web-server.md"
        )),
        None => Ok(format!(
            "relayed; the firewall has to close ports {first} to {last}, on which Webots listens"
        )),
    }
}

/// The first line that a program prints about its version.
///
/// # Errors
/// What is missing without the program.
fn version(program: &str, effect: &str) -> Result<String, String> {
    let printed = Command::new(program)
        .arg("--version")
        .output()
        .map(|output| output.stdout)
        .unwrap_or_default();
    let line = String::from_utf8_lossy(&printed).lines().next().map(str::to_owned);
    line.ok_or_else(|| format!("{program} is not there: {effect}"))
}
