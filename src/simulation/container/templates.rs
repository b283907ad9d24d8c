//! The templates for compose and Dockerfiles: the built-in ones, and the administrator's, which replace them.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::PathBuf;

use serde_json::Value;

use super::webots_yml::ProjectKind;
use crate::shared::config::ExpandedPath;
use crate::simulation::config::ContainerSettings;

/// Embeds a built-in template.
macro_rules! shipped {
    ($name:literal) => {
        ($name, include_str!(concat!("../../../config/simulation/docker/", $name)))
    };
}

/// A template for compose.
#[derive(Debug)]
pub struct Template {
    /// The unchanged file.
    pub text: Cow<'static, str>,
    /// Its services, and whether it has a command for each.
    pub services: BTreeMap<String, bool>,
}

/// The service of Webots.
pub const WEBOTS: &str = "webots";
/// The service of a participant's controller.
pub const CONTROLLER: &str = "controller";
/// The Dockerfile of a project that has none.
pub const DOCKERFILE: &str = "Dockerfile.default";
/// The Dockerfile of a competition's controllers that have none.
pub const CONTROLLER_DOCKERFILE: &str = "Dockerfile.controller";
/// The launcher of a participant's controller.
pub const LAUNCHER: &str = "remote_controller_launcher.py";

/// The problems of the administrator's files, with the line and what to write there.
pub fn faults(settings: &ContainerSettings) -> Vec<String> {
    let Some(ExpandedPath(folder)) = &settings.templates else { return Vec::new() };
    if let Err(error) = std::fs::read_dir(folder) {
        return vec![format!("container.templates, {}: {error}", folder.display())];
    }
    let kinds = [ProjectKind::Default, ProjectKind::Editor, ProjectKind::Competition];
    let files = [DOCKERFILE, CONTROLLER_DOCKERFILE, LAUNCHER];
    let faults = kinds.into_iter().filter_map(|kind| compose(settings, kind).err());
    faults.chain(files.into_iter().filter_map(|name| text(settings, name).err())).collect()
}

/// The template for what a project requests.
///
/// # Errors
/// Why it can't be used, as text for the client.
pub fn compose(settings: &ContainerSettings, kind: ProjectKind) -> Result<Template, String> {
    let kind = match kind {
        ProjectKind::Default => "default",
        ProjectKind::Editor => "theia",
        ProjectKind::Competition => "competition",
    };
    let name = format!("docker-compose-{kind}{}.yml", if settings.debug { "-debug" } else { "" });
    let broken = |error: String| format!("The template {name} of this simulation server can't be used: {error}");
    let text = text(settings, &name)?;
    let document: Value = serde_saphyr::from_str(&text).map_err(|error| broken(error.to_string()))?;
    let services = document.get("services").and_then(Value::as_object).into_iter().flatten();
    let has_command = |(name, service): (&String, &Value)| {
        (name.clone(), service.get("command").is_some_and(|command| !command.is_null()))
    };
    let services: BTreeMap<_, _> = services.map(has_command).collect();
    if !services.contains_key(WEBOTS) {
        return Err(broken(format!("it has no service {WEBOTS:?}")));
    }
    unsuitable(&text).map_or(Ok(Template { text, services }), |line| Err(broken(line)))
}

/// The administrator's file of this name, if there is one.
pub fn own(settings: &ContainerSettings, name: &str) -> Option<PathBuf> {
    let file = settings.templates.as_ref()?.0.join(name);
    file.is_file().then_some(file)
}

/// The text of a template.
///
/// # Errors
/// When the administrator's file can't be read, as text for an administrator.
pub fn text(settings: &ContainerSettings, name: &str) -> Result<Cow<'static, str>, String> {
    match own(settings, name).map(std::fs::read_to_string) {
        Some(text) => text.map(Cow::Owned).map_err(|error| format!("{name} of container.templates: {error}")),
        None => Ok(SHIPPED.iter().find(|(shipped, _)| *shipped == name).map_or("", |(_, text)| text).into()),
    }
}

/// What a template of the original has that can't work here, by the beginning of its line, and what to write there.
const UNSUITABLE: [(&str, &str); 5] = [
    ("networks:", "all services are in the network of container.network: leave it out"),
    ("network_mode:", "all services are in the network of container.network: leave it out"),
    ("volumes:", "programs can't write into a volume of Docker: mount ${PROJECT} or ${THEIA_FOLDER} instead"),
    ("build:", "images are built before: write `image: ${IMAGE}`, or ${CONTROLLER_IMAGE}"),
    ("reservations:", "container.gpu gives graphics cards where there are some: leave it out"),
];

/// The first line of a template that does not work here, and what to write there.
fn unsuitable(text: &str) -> Option<String> {
    text.lines().enumerate().find_map(|(index, line)| {
        // Services have an indented key of the same name for their mounts.
        let is_indented = |key: &str| !["volumes:", "networks:"].contains(&key);
        let is_key = |key: &str| line.starts_with(key) || is_indented(key) && line.trim_start().starts_with(key);
        let (_, advice) = UNSUITABLE.iter().find(|(key, _)| is_key(key))?;
        Some(format!("line {}, `{}`: {advice}", index + 1, line.trim()))
    })
}

/// The built-in templates.
const SHIPPED: [(&str, &str); 9] = [
    shipped!("docker-compose-default.yml"),
    shipped!("docker-compose-default-debug.yml"),
    shipped!("docker-compose-theia.yml"),
    shipped!("docker-compose-theia-debug.yml"),
    shipped!("docker-compose-competition.yml"),
    shipped!("docker-compose-competition-debug.yml"),
    shipped!("Dockerfile.default"),
    shipped!("Dockerfile.controller"),
    shipped!("remote_controller_launcher.py"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_only_the_original_could_run_is_refused_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let templates = Some(ExpandedPath(folder.path().to_owned()));
        let settings = ContainerSettings { templates, ..ContainerSettings::default() };
        for (text, words) in [
            ("volumes:\n  data:\nservices:\n  webots: {}\n", "line 1, `volumes:`"),
            ("services:\n  webots:\n    build:\n      context: .\n", "line 3, `build:`"),
            ("services:\n  webots:\n    network_mode: host\n", "line 3, `network_mode: host`"),
            (
                "services:\n  webots:\n    deploy:\n      resources:\n        reservations:\n          devices: []\n",
                "line 5",
            ),
            ("networks:\n  own: {}\nservices:\n  webots: {}\n", "line 1, `networks:`"),
            ("services: {}\n", "no service \"webots\""),
        ] {
            std::fs::write(folder.path().join("docker-compose-default.yml"), text).unwrap();
            let wrong = compose(&settings, ProjectKind::Default).unwrap_err();
            assert!(wrong.starts_with("The template docker-compose-default.yml") && wrong.contains(words), "{wrong}");
            assert_eq!(faults(&settings), [wrong]);
        }
        for kind in [ProjectKind::Editor, ProjectKind::Competition] {
            for debug in [false, true] {
                let settings = ContainerSettings { debug, ..ContainerSettings::default() };
                let template = compose(&settings, kind).unwrap();
                assert_eq!(template.text.contains("stdin_open: true"), debug, "{kind:?}");
            }
        }
    }
}
