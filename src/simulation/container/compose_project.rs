//! The compose project of a simulation: its services, and what each may do.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::{Value, json};
use which::which;

use super::build_plan::{PROJECT_PATH, ProjectPaths};
use super::built_image::BuiltImage;
use super::webots_yml::{ProjectKind, WebotsYml};
use crate::shared::domain::Failure;
use crate::simulation::checkout::Project;
use crate::simulation::config::{ContainerDisplay, EDITOR_PORT, SimulationConfig};
use crate::simulation::machine::sensors::Gpu;
use crate::simulation::process::own_call_failed;

/// A simulation that will run in containers.
#[derive(Debug)]
pub struct ContainerRequest {
    /// The project that was checked out.
    pub project: Arc<Project>,
    /// The port of Webots.
    pub port: u16,
    /// The GPU that it was given; without one, it gets all.
    pub gpu: Option<Gpu>,
    /// The address of its client, if it is known; images are built in its share.
    pub address: Option<IpAddr>,
    /// Webots and its arguments, without the world, which comes last.
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
    /// Whether Docker can give containers NVIDIA GPUs.
    pub nvidia: bool,
    /// The groups of the devices of other GPUs; `None` if there are no such GPUs.
    pub groups: Option<BTreeSet<u32>>,
}

/// The service of Webots.
pub const WEBOTS: &str = "webots";
/// The service of a participant's controller.
pub const CONTROLLER: &str = "controller";
/// The service of an editor, and the port that it listens on.
const EDITOR: (&str, u16) = ("theia", 3000);
/// Runs a program on a virtual display; part of the images of Webots.
const VIRTUAL_DISPLAY: [&str; 2] = ["xvfb-run", "--auto-servernum"];
/// The directory with the sockets of the machine's displays.
const DISPLAYS: &str = "/tmp/.X11-unix";

/// The program by which Docker gives containers NVIDIA GPUs: part of NVIDIA's container toolkit.
const NVIDIA_HOOK: &str = "nvidia-container-runtime-hook";
/// A device of NVIDIA's driver.
const NVIDIA: &str = "/dev/nvidiactl";
/// The directory of the devices of other GPUs.
const DRI: &str = "/dev/dri";

impl ComposeProject {
    /// Writes the file of the project. Returns the options by which compose finds it, and the names of the services. Blocks.
    ///
    /// # Errors
    /// When a path of the project can't be used, or a file can't be written.
    pub fn write(&self) -> Result<(Vec<String>, Vec<&'static str>), Failure> {
        let paths = ProjectPaths::of(&self.yml, &self.request.project)?;
        std::fs::create_dir_all(self.exchange()).map_err(|error| own_call_failed(&error))?;
        let services = self.services(&paths);
        let network = json!({ "default": { "external": true, "name": self.config.container.network.name() } });
        let project = json!({ "services": services, "networks": network });
        let file = self.request.project.instance.path().join("compose.json");
        // Without this, compose would expand variables.
        let text = project.to_string().replace('$', "$$");
        std::fs::write(&file, text).map_err(|error| own_call_failed(&error))?;
        let options = ["--project-name", &self.name, "--file", &file.to_string_lossy()].map(str::to_owned);
        Ok((options.into(), services.into_keys().collect()))
    }

    /// The directory through which Webots and a controller in another container communicate.
    fn exchange(&self) -> PathBuf {
        self.request.project.instance.path().join("ipc")
    }

    /// The services. An editor mounts only its directory of the project; a controller also the exchange with Webots.
    fn services(&self, paths: &ProjectPaths) -> BTreeMap<&'static str, Service> {
        let config = &self.config;
        let port = self.request.port;
        let access = GpuAccess::find();
        let mount = |folder: &Path, to: &str| format!("{}:{to}", folder.display());
        let published = |outside: u16, to: u16| json!([format!("{}:{outside}:{to}", config.bind_of_containers())]);
        // Webots up to R2023a uses the first path; later versions create directories per user and port in the second.
        let exchange =
            || [format!("/tmp/webots-{port}"), "/tmp/webots".to_owned()].map(|to| mount(&self.exchange(), &to));
        let service = |name, image: &str, volumes, environment: &[(&'static str, String)]| {
            let mut service = protected(name, &access, self.request.gpu.as_ref(), config, volumes, environment);
            service.insert("container_name", json!(container_of(&self.name, name)));
            service.insert("image", json!(image));
            service
        };
        let of_controller = self.controller.iter().flat_map(|_| exchange());
        let volumes = of_controller.chain([mount(&paths.project, PROJECT_PATH)]).collect();
        let mut webots = service(WEBOTS, &self.image.name, volumes, &[]);
        webots.insert("working_dir", json!(PROJECT_PATH));
        webots.insert("ports", published(port, port));
        webots.insert("entrypoint", json!(self.image.entrypoint()));
        webots.insert("command", json!(self.command(paths)));
        let mut services = BTreeMap::from([(WEBOTS, webots)]);
        if let Some(image) = &self.controller {
            let participant = mount(&paths.edited, &format!("/usr/local/{}", self.yml.folder));
            // webots-controller finds Webots by its port, and forwards the participant's output to Webots' console.
            let environment = [
                ("PORT", port.to_string()),
                ("WEBOTS_CONTROLLER_URL", "participant".to_owned()),
                ("WEBOTS_STDOUT_REDIRECT", "1".to_owned()),
                ("WEBOTS_STDERR_REDIRECT", "1".to_owned()),
            ];
            let volumes = exchange().into_iter().chain([participant]).collect();
            let mut controller = service(CONTROLLER, &image.name, volumes, &environment);
            // With a terminal, programs flush their output after each line.
            controller.insert("tty", json!(true));
            controller.insert("entrypoint", json!(image.entrypoint()));
            controller.insert("command", json!(image.command()));
            services.insert(CONTROLLER, controller);
        }
        if self.yml.kind != ProjectKind::Default {
            let shown = vec![mount(&paths.edited, "/home/project/webots-project")];
            let mut editor = service(EDITOR.0, &config.container.editor_image, shown, &[]);
            editor.insert("ports", published(port + EDITOR_PORT, EDITOR.1));
            services.insert(EDITOR.0, editor);
        }
        services
    }

    /// The command of Webots.
    fn command(&self, paths: &ProjectPaths) -> Vec<String> {
        let display = match self.config.container.display {
            ContainerDisplay::Virtual => VIRTUAL_DISPLAY.map(str::to_owned).into(),
            ContainerDisplay::Machine => Vec::new(),
        };
        [
            display,
            self.request.command.clone(),
            vec![format!("{PROJECT_PATH}/{}", paths.world)],
        ]
        .concat()
    }
}

impl GpuAccess {
    /// Detects the GPUs.
    pub fn find() -> Self {
        let group = |file: std::fs::DirEntry| Some(file.metadata().ok()?.gid());
        let groups = std::fs::read_dir(DRI)
            .ok()
            .map(|files| files.flatten().filter_map(group).collect());
        let nvidia = Path::new(NVIDIA).exists() && which(NVIDIA_HOOK).is_ok();
        Self { nvidia, groups }
    }
}

/// The settings of the service with this name, with these mounts and variables.
fn protected(
    name: &str,
    access: &GpuAccess,
    gpu: Option<&Gpu>,
    config: &SimulationConfig,
    mut volumes: Vec<String>,
    environment: &[(&'static str, String)],
) -> Service {
    let settings = &config.container;
    let limits = &config.limits;
    let memory = format!("{}m", limits.memory.unwrap_or(DEFAULT_MEMORY));
    // Programs have to write there.
    let in_memory = [("/tmp", limits.disk), ("/var/tmp", limits.disk), ("/run", 16)]
        .map(|(path, size)| format!("{path}:rw,exec,nosuid,nodev,mode=1777,size={size}m"));
    let mut service = Service::from_iter([
        ("restart", json!("no")),
        ("privileged", json!(false)),
        ("read_only", json!(settings.read_only)),
        ("cap_drop", json!(["ALL"])),
        ("cap_add", json!(settings.capabilities)),
        (
            "security_opt",
            json!([format!("no-new-privileges:{}", !settings.new_privileges)]),
        ),
        (
            "user",
            json!(format!("{}:{}", nix::unistd::getuid(), nix::unistd::getgid())),
        ),
        ("tmpfs", json!(in_memory)),
        // The browser engine inside Webots needs it.
        ("shm_size", json!("256m")),
        ("mem_limit", json!(memory)),
        ("memswap_limit", json!(memory)),
        ("pids_limit", json!(limits.processes)),
        (
            "ulimits",
            json!({ "nofile": { "soft": limits.open_files.min(1024), "hard": limits.open_files }, "core": 0 }),
        ),
        ("logging", json!({ "driver": "none" })),
        // Reaps orphans and forwards signals.
        ("init", json!(true)),
        // The daemon would run the health check of the image, at an interval that the image chooses.
        ("healthcheck", json!({ "disable": true })),
    ]);
    service.extend(limits.cores.map(|cores| ("cpus", json!(cores))));
    let mut environment: BTreeMap<_, _> = environment.iter().cloned().collect();
    environment.extend(ENVIRONMENT.map(|(name, value)| (name, value.to_owned())));
    // The entry points of the images of Webots and of controllers create it.
    let home = if [WEBOTS, CONTROLLER].contains(&name) {
        "/tmp/home"
    } else {
        "/tmp"
    };
    environment.insert("HOME", home.to_owned());
    if name == WEBOTS {
        volumes.extend(settings.mounts.clone());
        if settings.display == ContainerDisplay::Machine {
            environment.insert("DISPLAY", config.display_on(gpu.map(|gpu| gpu.index)));
            volumes.push(format!("{DISPLAYS}:{DISPLAYS}"));
            if let Some(authority) = std::env::var_os("XAUTHORITY") {
                let authority = authority.to_string_lossy().into_owned();
                volumes.push(format!("{authority}:{authority}:ro"));
                environment.insert("XAUTHORITY", authority);
            }
        }
    }
    service.insert("volumes", json!(volumes));
    if name == WEBOTS && settings.gpu {
        if let Some(groups) = &access.groups {
            service.insert("devices", json!(["/dev/dri:/dev/dri"]));
            service.insert(
                "group_add",
                json!(groups.iter().map(u32::to_string).collect::<Vec<_>>()),
            );
        }
        if access.nvidia {
            // An image may request all GPUs by this variable.
            environment.extend(gpu.map(|gpu| ("NVIDIA_VISIBLE_DEVICES", gpu.id.clone())));
            let (key, value) = gpu.map_or(("count", json!("all")), |gpu| ("device_ids", json!([gpu.id])));
            let devices = json!({ "driver": "nvidia", key: value, "capabilities": ["gpu"] });
            service.insert(
                "deploy",
                json!({ "resources": { "reservations": { "devices": [devices] } } }),
            );
            environment.insert("NVIDIA_DRIVER_CAPABILITIES", "all".to_owned());
        }
    }
    service.insert("environment", json!(environment));
    service
}

/// The name of the container of a service of a compose project.
pub fn container_of(project: &str, service: &str) -> String {
    format!("{project}-{service}")
}

/// The settings of a service for compose.
type Service = BTreeMap<&'static str, Value>;

/// Variables of all services: with them programs write only to writable paths, and find each other.
const ENVIRONMENT: [(&str, &str); 3] = [
    ("USER", "webots"),
    ("XDG_RUNTIME_DIR", "/tmp"),
    ("QT_X11_NO_MITSHM", "1"),
];

/// Memory limit of a container without `limits.memory`, in MiB.
pub const DEFAULT_MEMORY: u64 = 4096;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::config::ContainerSettings;

    #[test]
    fn a_container_gets_the_chosen_gpu_and_its_display() {
        let keys = json!({ "isolation": "container", "gpus": "spread", "displays": [":0.0", ":0.1"], "display": ":7" });
        let mut config: SimulationConfig = serde_json::from_value(keys).unwrap();
        config.container = ContainerSettings {
            display: ContainerDisplay::Machine,
            ..ContainerSettings::default()
        };
        let access = GpuAccess {
            nvidia: true,
            groups: None,
        };
        let gpu = Gpu {
            index: 1,
            id: "GPU-b".to_owned(),
            ..Gpu::default()
        };
        let service = |gpu: Option<&Gpu>, name: &str| json!(protected(name, &access, gpu, &config, Vec::new(), &[]));
        let devices = |service: &Value| service["deploy"]["resources"]["reservations"]["devices"].clone();
        let one = service(Some(&gpu), "webots");
        let expected = json!([{ "driver": "nvidia", "device_ids": ["GPU-b"], "capabilities": ["gpu"] }]);
        assert_eq!(devices(&one), expected);
        assert_eq!(
            (
                &one["environment"]["DISPLAY"],
                &one["environment"]["NVIDIA_VISIBLE_DEVICES"]
            ),
            (&json!(":0.1"), &json!("GPU-b"))
        );
        let all = service(None, "webots");
        assert_eq!(
            devices(&all),
            json!([{ "driver": "nvidia", "count": "all", "capabilities": ["gpu"] }])
        );
        assert_eq!(
            (
                &all["environment"]["DISPLAY"],
                &all["environment"]["NVIDIA_VISIBLE_DEVICES"]
            ),
            (&json!(":0.0"), &Value::Null)
        );
        assert_eq!(devices(&service(Some(&gpu), "theia")), Value::Null);
    }
}
