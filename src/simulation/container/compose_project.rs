//! The files of a compose project: the template, its variables, and the settings that override the template for each
//! service.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::build_plan::PROJECT_PATH;
use super::built_image::BuiltImage;
use super::docker_features::DockerFeatures;
use super::templates::{CONTROLLER, Template, WEBOTS};
use crate::simulation::config::{ContainerDisplay, EDITOR_PORT, SimulationConfig};
use crate::simulation::machine::sensors::Gpu;

/// The parts of the compose project of one simulation.
#[derive(Debug)]
pub struct ComposeProject<'parts> {
    /// Its name; unique on this machine.
    pub name: &'parts str,
    /// The directory of the instance, which contains its files.
    pub instance: &'parts Path,
    /// The directory of the project on the machine.
    pub project: &'parts Path,
    /// The directory that the editor shows.
    pub edited: &'parts Path,
    /// The directory for the editor, as in the project's `webots.yml`.
    pub volume: &'parts str,
    /// The image of Webots.
    pub image: &'parts BuiltImage,
    /// The image of a competition's controller.
    pub controller: Option<&'parts BuiltImage>,
    /// Webots and its arguments in the container.
    pub command: &'parts [String],
    /// The port of Webots.
    pub port: u16,
    /// The GPU that it was given.
    pub gpu: Option<&'parts Gpu>,
    /// Whether there is a Makefile.
    pub has_makefile: bool,
    /// The features of this machine's Docker.
    pub features: &'parts DockerFeatures,
}

/// Environment variables: names and values.
pub type Variables = Vec<(&'static str, String)>;

/// File name of the template.
const TEMPLATE: &str = "docker-compose.yml";
/// The settings of each service, which override the template.
const OVERRIDE: &str = "override.json";
/// Size of shared memory: what a browser's engine inside of Webots needs.
const SHARED_MEMORY: &str = "256m";
/// The directory with the sockets of the machine's displays.
const DISPLAYS: &str = "/tmp/.X11-unix";

impl ComposeProject<'_> {
    /// Writes the files, and returns the options by which compose finds them, and the variables that it has to have: those of
    /// this server's environment would count for more than a file of them.
    ///
    /// # Errors
    /// When a file can't be written.
    pub fn write(&self, template: &Template, config: &SimulationConfig) -> io::Result<(Vec<String>, Variables)> {
        let folder = self.instance.join("compose");
        std::fs::create_dir_all(&folder)?;
        std::fs::create_dir_all(self.exchange())?;
        std::fs::write(folder.join(TEMPLATE), template.text.as_bytes())?;
        std::fs::write(folder.join(OVERRIDE), self.overridden(template, config).to_string())?;
        let path = |name: &str| folder.join(name).to_string_lossy().into_owned();
        let options = ["--file", &path(TEMPLATE), "--file", &path(OVERRIDE)].map(str::to_owned);
        Ok((options.into(), self.variables(config)))
    }

    /// The directory through which Webots and a controller in another container communicate.
    fn exchange(&self) -> PathBuf {
        self.instance.join("ipc")
    }

    /// The variables of the template.
    fn variables(&self, config: &SimulationConfig) -> Variables {
        let command = self.command.join(" ");
        let plain = |letter: char| letter.is_alphanumeric() || " -_./=:+,".contains(letter);
        // A template may pass it to a shell, which interprets quotes, dollars and backslashes.
        let command = if command.chars().all(plain) { command } else { String::new() };
        let path = |path: &Path| path.to_string_lossy().into_owned();
        vec![
            ("IMAGE", self.image.name.clone()),
            ("CONTROLLER_IMAGE", self.controller.map_or_else(String::new, |image| image.name.clone())),
            ("PROJECT_PATH", PROJECT_PATH.to_owned()),
            ("PROJECT", path(self.project)),
            ("MAKE", u8::from(self.has_makefile).to_string()),
            ("BIND", config.bind_of_containers().to_string()),
            ("PORT", self.port.to_string()),
            ("COMPOSE_PROJECT_NAME", self.name.to_owned()),
            ("WEBOTS", command),
            ("THEIA_IMAGE", config.container.editor_image.clone()),
            ("THEIA_VOLUME", self.volume.to_owned()),
            ("THEIA_FOLDER", path(self.edited)),
            ("THEIA_PORT", (self.port + EDITOR_PORT).to_string()),
            ("IPC", path(&self.exchange())),
            ("DISPLAY", self.display(config).unwrap_or_default()),
        ]
    }

    /// The display of the machine, where that is asked for.
    fn display(&self, config: &SimulationConfig) -> Option<String> {
        let is_machine = config.container.display == ContainerDisplay::Machine;
        is_machine.then(|| config.display_on(self.gpu.map(|gpu| gpu.index)))
    }

    /// The settings of each service, which override the template.
    fn overridden(&self, template: &Template, config: &SimulationConfig) -> Value {
        let service = |(name, has_command): (&String, &bool)| (name.clone(), self.service(name, *has_command, config));
        let services: serde_json::Map<String, Value> = template.services.iter().map(service).collect();
        let network = json!({ "default": { "external": true, "name": config.container.network.name() } });
        json!({ "services": services, "networks": network })
    }

    fn service(&self, name: &str, has_command: bool, config: &SimulationConfig) -> Value {
        let (settings, limits) = (&config.container, &config.limits);
        let memory = format!("{}m", limits.memory.unwrap_or(DEFAULT_MEMORY));
        let mut service = Service::from_iter([
            ("container_name", json!(container_of(self.name, name))),
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
            (
                "ulimits",
                json!({ "nofile": { "soft": limits.open_files.min(1024), "hard": limits.open_files }, "core": 0 }),
            ),
            ("logging", json!({ "driver": "none" })),
            // Reaps orphans and forwards signals. The server checks at its start that Docker has one.
            ("init", json!(true)),
            // The daemon would run it, at the interval of the image.
            ("healthcheck", json!({ "disable": true })),
        ]);
        service.extend(limits.cores.map(|cores| ("cpus", json!(cores))));
        let mut environment = ENVIRONMENT.map(|(name, value)| (name, value.to_owned())).to_vec();
        let built = match name {
            WEBOTS => Some((self.image, self.command.to_vec())),
            CONTROLLER => self.controller.map(|image| (image, image.command())),
            _ => None,
        };
        // Its entry point creates it.
        environment.push(("HOME", if built.is_some() { "/tmp/home" } else { "/tmp" }.to_owned()));
        if let Some((image, command)) = built {
            let plain =
                |words: Vec<String>| json!(words.iter().map(|word| word.replace('$', "$$")).collect::<Vec<_>>());
            service.insert("entrypoint", plain(image.entrypoint()));
            // With an entry point here the image's own command does not count.
            service.extend((!has_command).then(|| ("command", plain(command))));
        }
        if name == WEBOTS {
            self.show(&mut service, &mut environment, config);
        }
        service.insert("environment", json!(BTreeMap::from_iter(environment)));
        json!(service)
    }

    /// Gives Webots the GPUs, the display of the machine, and the administrator's directories.
    fn show(&self, service: &mut Service, environment: &mut Vec<(&'static str, String)>, config: &SimulationConfig) {
        let mut volumes: Vec<String> = config.container.mounts.clone();
        if let Some(display) = self.display(config) {
            environment.push(("DISPLAY", display));
            volumes.push(format!("{DISPLAYS}:{DISPLAYS}"));
            if let Some(authority) = std::env::var_os("XAUTHORITY") {
                let authority = authority.to_string_lossy().into_owned();
                volumes.push(format!("{authority}:{authority}:ro"));
                environment.push(("XAUTHORITY", authority));
            }
        }
        service.insert("volumes", json!(volumes));
        if let Some(groups) = self.features.graphics.as_ref().filter(|_| config.container.gpu) {
            service.insert("devices", json!(["/dev/dri:/dev/dri"]));
            service.insert("group_add", json!(groups.iter().map(u32::to_string).collect::<Vec<_>>()));
        }
        if self.features.nvidia && config.container.gpu {
            // An image or a template may ask for all by this variable.
            environment.extend(self.gpu.map(|gpu| ("NVIDIA_VISIBLE_DEVICES", gpu.id.clone())));
            let (key, value) = self.gpu.map_or(("count", json!("all")), |gpu| ("device_ids", json!([gpu.id])));
            let devices = json!({ "driver": "nvidia", key: value, "capabilities": ["gpu"] });
            service.insert("deploy", json!({ "resources": { "reservations": { "devices": [devices] } } }));
            environment.push(("NVIDIA_DRIVER_CAPABILITIES", "all".to_owned()));
        }
    }
}

/// Directories in memory with a size limit, into which programs must write.
fn memory_folders(size: u64) -> [String; 3] {
    [("/tmp", size), ("/var/tmp", size), ("/run", 16)]
        .map(|(path, size)| format!("{path}:rw,exec,nosuid,nodev,mode=1777,size={size}m"))
}

/// The name of the container of a service of a compose project.
#[must_use]
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
        let features = DockerFeatures { nvidia: true, graphics: None };
        let gpu = Gpu { index: 1, id: "GPU-b".to_owned(), ..Gpu::default() };
        let service = |gpu: Option<&Gpu>, name: &str| {
            let (folder, command) = (Path::new("/srv/one"), ["webots".to_owned()]);
            let parts = ComposeProject {
                name: "one",
                instance: folder,
                project: folder,
                edited: folder,
                volume: "",
                image: &BuiltImage::default(),
                controller: None,
                command: &command,
                port: 2001,
                gpu,
                has_makefile: false,
                features: &features,
            };
            parts.service(name, false, &config)
        };
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
