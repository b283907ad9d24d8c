//! The files of a compose project: the template, its variables, and the settings that override the template for each
//! service.

use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::{Value, json};
use which::which;

use super::build_plan::PROJECT_PATH;
use super::built_image::BuiltImage;
use super::project_paths::ProjectPaths;
use super::start_error::StartError;
use super::templates::{CONTROLLER, Template, WEBOTS};
use super::webots_yml::WebotsYml;
use crate::simulation::checkout::Project;
use crate::simulation::config::{ContainerDisplay, EDITOR_PORT, SimulationConfig};
use crate::simulation::machine::sensors::Gpu;

/// A simulation that will run in containers.
#[derive(Debug)]
pub struct ContainerRequest {
    /// The project that was checked out.
    pub project: Arc<Project>,
    /// The port of Webots.
    pub port: u16,
    /// The GPU that it was given; without one, it gets all.
    pub gpu: Option<Gpu>,
    /// Webots and its arguments, but for the world, which is the last.
    pub command: Vec<String>,
}

/// The compose project of one simulation.
#[derive(Debug)]
pub struct ComposeProject {
    /// Its name; unique on this machine.
    pub name: String,
    /// What was requested.
    pub request: ContainerRequest,
    /// What its project's `webots.yml` requests.
    pub yml: WebotsYml,
    /// The template for that.
    pub template: Template,
    /// The image of Webots.
    pub image: BuiltImage,
    /// The image of a competition's controller.
    pub controller: Option<BuiltImage>,
    /// The configuration.
    pub config: Arc<SimulationConfig>,
}

/// The access that containers can have to the GPUs of this machine.
#[derive(Debug)]
pub struct GpuAccess {
    /// Whether Docker can give out NVIDIA GPUs.
    pub nvidia: bool,
    /// The groups of the devices of other GPUs; `None` if there are no such GPUs.
    pub groups: Option<BTreeSet<u32>>,
}

/// Environment variables: names and values.
pub type Variables = Vec<(&'static str, String)>;

/// Size of shared memory: what a browser's engine inside of Webots needs.
const SHARED_MEMORY: &str = "256m";
/// Runs a program on a virtual display; part of the images of Webots.
const VIRTUAL_DISPLAY: [&str; 2] = ["xvfb-run", "--auto-servernum"];
/// The directory with the sockets of the machine's displays.
const DISPLAYS: &str = "/tmp/.X11-unix";

/// The program by which Docker gives out NVIDIA GPUs: part of NVIDIA's container toolkit.
const NVIDIA_HOOK: &str = "nvidia-container-runtime-hook";
/// A device of NVIDIA's driver.
const NVIDIA: &str = "/dev/nvidiactl";
/// The directory of the devices of other GPUs.
const DRI: &str = "/dev/dri";

impl ComposeProject {
    /// Writes the files, and returns the options by which compose finds them, and the variables that it has to have: those of
    /// this server's environment would count for more than a file of them. Blocks.
    ///
    /// # Errors
    /// When a path of the project can't be used, or a file can't be written.
    pub fn write(&self) -> Result<(Vec<String>, Variables), StartError> {
        let paths = ProjectPaths::of(&self.yml, &self.request.project)?;
        let folder = self.request.project.instance.path().join("compose");
        std::fs::create_dir_all(&folder)?;
        std::fs::create_dir_all(self.exchange())?;
        let path = |name: &str| folder.join(name).to_string_lossy().into_owned();
        let (template, overridden) = (path("docker-compose.yml"), path("override.json"));
        let display = match self.config.container.display {
            ContainerDisplay::Virtual => VIRTUAL_DISPLAY.map(str::to_owned).into(),
            ContainerDisplay::Machine => Vec::new(),
        };
        let world = format!("{PROJECT_PATH}/{}", paths.world);
        let command = [display, self.request.command.clone(), vec![world]].concat();
        std::fs::write(&template, self.template.text.as_bytes())?;
        std::fs::write(&overridden, self.overridden(&command).to_string())?;
        let options = ["--file", &template, "--file", &overridden].map(str::to_owned);
        Ok((options.into(), self.variables(&command, &paths)))
    }

    /// The directory through which Webots and a controller in another container communicate.
    fn exchange(&self) -> PathBuf {
        self.request.project.instance.path().join("ipc")
    }

    /// The variables of the template.
    fn variables(&self, command: &[String], paths: &ProjectPaths) -> Variables {
        let command = command.join(" ");
        let plain = |letter: char| letter.is_alphanumeric() || " -_./=:+,".contains(letter);
        // A template may pass it to a shell, which interprets quotes, dollars and backslashes.
        let command = if command.chars().all(plain) { command } else { String::new() };
        let path = |path: &Path| path.to_string_lossy().into_owned();
        let (config, port) = (&self.config, self.request.port);
        vec![
            ("IMAGE", self.image.name.clone()),
            ("CONTROLLER_IMAGE", self.controller.as_ref().map_or_else(String::new, |image| image.name.clone())),
            ("PROJECT_PATH", PROJECT_PATH.to_owned()),
            ("PROJECT", path(&paths.project)),
            ("BIND", config.bind_of_containers().to_string()),
            ("PORT", port.to_string()),
            ("COMPOSE_PROJECT_NAME", self.name.clone()),
            ("WEBOTS", command),
            ("THEIA_IMAGE", config.container.editor_image.clone()),
            ("THEIA_VOLUME", self.yml.folder.clone()),
            ("THEIA_FOLDER", path(&paths.edited)),
            ("THEIA_PORT", (port + EDITOR_PORT).to_string()),
            ("IPC", path(&self.exchange())),
            ("DISPLAY", display(config, self.request.gpu.as_ref()).unwrap_or_default()),
        ]
    }

    /// The settings of each service, which override the template.
    fn overridden(&self, command: &[String]) -> Value {
        let access = GpuAccess::find();
        let service = |(name, has_command): (&String, &bool)| {
            let mut service = protected(name, &access, self.request.gpu.as_ref(), &self.config);
            service.insert("container_name", json!(container_of(&self.name, name)));
            let built = match name.as_str() {
                WEBOTS => Some((&self.image, command.to_vec())),
                CONTROLLER => self.controller.as_ref().map(|image| (image, image.command())),
                _ => None,
            };
            if let Some((image, command)) = built {
                let plain =
                    |words: Vec<String>| json!(words.iter().map(|word| word.replace('$', "$$")).collect::<Vec<_>>());
                service.insert("entrypoint", plain(image.entrypoint()));
                // With an entry point here the image's own command does not count.
                service.extend((!has_command).then(|| ("command", plain(command))));
            }
            (name.clone(), json!(service))
        };
        let services: serde_json::Map<String, Value> = self.template.services.iter().map(service).collect();
        let network = json!({ "default": { "external": true, "name": self.config.container.network.name() } });
        json!({ "services": services, "networks": network })
    }
}

impl GpuAccess {
    /// Looks for the GPUs.
    pub fn find() -> Self {
        let group = |file: std::fs::DirEntry| Some(file.metadata().ok()?.gid());
        let groups = std::fs::read_dir(DRI).ok().map(|files| files.flatten().filter_map(group).collect());
        let nvidia = Path::new(NVIDIA).exists() && which(NVIDIA_HOOK).is_ok();
        Self { nvidia, groups }
    }
}

/// The display of the machine, where that is asked for.
fn display(config: &SimulationConfig, gpu: Option<&Gpu>) -> Option<String> {
    let is_machine = config.container.display == ContainerDisplay::Machine;
    is_machine.then(|| config.display_on(gpu.map(|gpu| gpu.index)))
}

/// The settings of the service with this name, whatever its template has.
fn protected(name: &str, access: &GpuAccess, gpu: Option<&Gpu>, config: &SimulationConfig) -> Service {
    let (settings, limits) = (&config.container, &config.limits);
    let memory = format!("{}m", limits.memory.unwrap_or(DEFAULT_MEMORY));
    let mut service = Service::from_iter([
        ("restart", json!("no")),
        ("privileged", json!(false)),
        ("read_only", json!(settings.read_only)),
        ("cap_drop", json!(["ALL"])),
        ("cap_add", json!(settings.capabilities)),
        ("security_opt", json!([format!("no-new-privileges:{}", !settings.new_privileges)])),
        ("user", json!(format!("{}:{}", nix::unistd::getuid(), nix::unistd::getgid()))),
        ("tmpfs", json!(memory_folders(limits.disk))),
        ("shm_size", json!(SHARED_MEMORY)),
        ("mem_limit", json!(memory)),
        ("memswap_limit", json!(memory)),
        ("pids_limit", json!(limits.processes)),
        ("ulimits", json!({ "nofile": { "soft": limits.open_files.min(1024), "hard": limits.open_files }, "core": 0 })),
        ("logging", json!({ "driver": "none" })),
        // Reaps orphans and forwards signals. The server checks at its start that Docker has one.
        ("init", json!(true)),
        // The daemon would run it, at the interval of the image.
        ("healthcheck", json!({ "disable": true })),
    ]);
    service.extend(limits.cores.map(|cores| ("cpus", json!(cores))));
    let mut environment = BTreeMap::from(ENVIRONMENT.map(|(name, value)| (name, value.to_owned())));
    // The entry points of the images of Webots and of controllers create it.
    let home = if [WEBOTS, CONTROLLER].contains(&name) { "/tmp/home" } else { "/tmp" };
    environment.insert("HOME", home.to_owned());
    if name == WEBOTS {
        let mut volumes: Vec<String> = settings.mounts.clone();
        if let Some(display) = display(config, gpu) {
            environment.insert("DISPLAY", display);
            volumes.push(format!("{DISPLAYS}:{DISPLAYS}"));
            if let Some(authority) = std::env::var_os("XAUTHORITY") {
                let authority = authority.to_string_lossy().into_owned();
                volumes.push(format!("{authority}:{authority}:ro"));
                environment.insert("XAUTHORITY", authority);
            }
        }
        service.insert("volumes", json!(volumes));
    }
    if name == WEBOTS && settings.gpu {
        if let Some(groups) = &access.groups {
            service.insert("devices", json!(["/dev/dri:/dev/dri"]));
            service.insert("group_add", json!(groups.iter().map(u32::to_string).collect::<Vec<_>>()));
        }
        if access.nvidia {
            // An image or a template may ask for all by this variable.
            environment.extend(gpu.map(|gpu| ("NVIDIA_VISIBLE_DEVICES", gpu.id.clone())));
            let (key, value) = gpu.map_or(("count", json!("all")), |gpu| ("device_ids", json!([gpu.id])));
            let devices = json!({ "driver": "nvidia", key: value, "capabilities": ["gpu"] });
            service.insert("deploy", json!({ "resources": { "reservations": { "devices": [devices] } } }));
            environment.insert("NVIDIA_DRIVER_CAPABILITIES", "all".to_owned());
        }
    }
    service.insert("environment", json!(environment));
    service
}

/// Directories in memory with a size limit, into which programs must write.
fn memory_folders(size: u64) -> [String; 3] {
    [("/tmp", size), ("/var/tmp", size), ("/run", 16)]
        .map(|(path, size)| format!("{path}:rw,exec,nosuid,nodev,mode=1777,size={size}m"))
}

/// The name of the container of a service of a compose project.
pub fn container_of(project: &str, service: &str) -> String {
    format!("{project}-{service}")
}

/// The settings of a service for compose.
type Service = BTreeMap<&'static str, Value>;

/// Variables of all services: with them programs write only to writable paths, and find each other.
const ENVIRONMENT: [(&str, &str); 3] = [("USER", "webots"), ("XDG_RUNTIME_DIR", "/tmp"), ("QT_X11_NO_MITSHM", "1")];

/// Memory limit of a container without `limits.memory`, in MiB.
pub const DEFAULT_MEMORY: u64 = 4096;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::config::ContainerSettings;

    #[test]
    fn a_container_gets_the_gpu_that_was_chosen_and_its_display_or_all_gpus() {
        let keys = json!({ "isolation": "container", "gpus": "spread", "displays": [":0.0", ":0.1"], "display": ":7" });
        let mut config: SimulationConfig = serde_json::from_value(keys).unwrap();
        config.container = ContainerSettings { display: ContainerDisplay::Machine, ..ContainerSettings::default() };
        let access = GpuAccess { nvidia: true, groups: None };
        let gpu = Gpu { index: 1, id: "GPU-b".to_owned(), ..Gpu::default() };
        let service = |gpu: Option<&Gpu>, name: &str| json!(protected(name, &access, gpu, &config));
        let devices = |service: &Value| service["deploy"]["resources"]["reservations"]["devices"].clone();
        let one = service(Some(&gpu), "webots");
        let expected = json!([{ "driver": "nvidia", "device_ids": ["GPU-b"], "capabilities": ["gpu"] }]);
        assert_eq!(devices(&one), expected);
        assert_eq!(
            (&one["environment"]["DISPLAY"], &one["environment"]["NVIDIA_VISIBLE_DEVICES"]),
            (&json!(":0.1"), &json!("GPU-b"))
        );
        let all = service(None, "webots");
        assert_eq!(devices(&all), json!([{ "driver": "nvidia", "count": "all", "capabilities": ["gpu"] }]));
        assert_eq!(
            (&all["environment"]["DISPLAY"], &all["environment"]["NVIDIA_VISIBLE_DEVICES"]),
            (&json!(":0.0"), &Value::Null)
        );
        assert_eq!(devices(&service(Some(&gpu), "theia")), Value::Null);
    }
}
