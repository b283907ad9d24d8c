//! An image that this server has built: how its containers start, and which of its files they may change.
//!
//! Simulations run as the server's user, so that the server can read, measure and remove what they write, and so that
//! no program in a directory of this machine ever runs as root. Official images of Webots keep assets and settings in
//! the home directory of root, so each container starts with a home directory that has the files of the home of the
//! image's own user.

use std::path::Path;
use std::time::Duration;

use serde::Deserialize;
use serde_json::Value;

use super::docker::{Docker, DockerError, SHORT_TIMEOUT};
use super::dockerfile::NO_VOLUME;
use super::failures::{of_project, on_thread};
use super::owned_resources::REMOVE;
use crate::shared::domain::{Failure, Reason};
use crate::shared::text::one_line;
use crate::simulation::checkout::{Project, outgrown};
use crate::simulation::config::SimulationConfig;
use crate::simulation::process::{disk_fault, own_call_failed, remove_tree};

/// An image: its name, and the configuration of its programs, as Docker reports it.
#[derive(Debug, Default, Deserialize)]
#[serde(rename_all = "PascalCase", default)]
pub struct BuiltImage {
    /// Its name; unique on this machine.
    #[serde(skip)]
    pub name: String,
    /// Its user, `root` if empty.
    user: String,
    /// Its environment variables.
    env: Option<Vec<String>>,
    /// The program that gets the command.
    entrypoint: Option<Vec<String>>,
    /// The command if none is given.
    cmd: Option<Vec<String>>,
    /// The directories of its volumes.
    volumes: Option<serde_json::Map<String, Value>>,
}

/// The first output of a container when it runs: from then on its network has an address.
pub const RUNS: &str = "webots-fleet: the container runs";
/// Timeout of a copy out of an image.
const COPY_TIMEOUT: Duration = Duration::from_mins(2);
/// The first program of a container.
const START_AT_HOME: &str = include_str!("../../../config/simulation/docker/start-at-home");

impl BuiltImage {
    /// Parses what `docker image inspect` prints of the configuration of this image.
    ///
    /// # Errors
    /// When it can't be parsed, or the image has a volume; as text for the client.
    pub fn read(name: String, json: &str) -> Result<Self, String> {
        let image: Self = serde_json::from_str(json)
            .map_err(|error| format!("The configuration of the image can't be read: {error}"))?;
        match image.volumes.as_ref().and_then(|volumes| volumes.keys().next()) {
            Some(path) => Err(format!(
                "The image that it begins with has `VOLUME {}`: {NO_VOLUME}",
                one_line(path)
            )),
            None => Ok(Self { name, ..image }),
        }
    }

    /// The entry point of its containers: the first program, which runs that of the image.
    pub fn entrypoint(&self) -> Vec<String> {
        let home = self
            .env
            .iter()
            .flatten()
            .find_map(|variable| variable.strip_prefix("HOME="));
        let user = self
            .user
            .split(':')
            .next()
            .filter(|user| !user.is_empty())
            .unwrap_or("root");
        let first = ["/bin/sh", "-c", START_AT_HOME, "start-at-home", home.unwrap_or(user)];
        first
            .map(str::to_owned)
            .into_iter()
            .chain(self.entrypoint.iter().flatten().cloned())
            .collect()
    }

    /// The command of its containers if none is given.
    pub fn command(&self) -> Vec<String> {
        self.cmd.clone().unwrap_or_default()
    }
}

/// Copies a directory of an image to `to`, where containers can change it: the build may have created files in it. `to` is
/// created or replaced, through a temporary directory of the project's instance. `name` is the compose project, from
/// which the name of the temporary container derives.
///
/// # Errors
/// Why not.
pub async fn export(
    image: &BuiltImage,
    (docker, config): (&Docker, &SimulationConfig),
    name: &str,
    from: &Path,
    project: &Project,
    to: &Path,
) -> Result<(), Failure> {
    let name = format!("{name}-{:08x}", rand::random::<u32>());
    let reserve = config.disk_reserve;
    let create = ["create", "--name", &name, "--network", "none", &image.name, "true"];
    if let Err(error) = docker.run(&create, SHORT_TIMEOUT).await {
        let otherwise = error.unless_slow(of_project(
            "Docker can't create a container of the image of this project",
        ));
        return Err(docker.explain(error, reserve, otherwise).await);
    }
    let through = project.instance.path().join("copied");
    let source = format!("{name}:{}/.", from.display());
    let words = ["cp", &source, &through.to_string_lossy()].map(str::to_owned);
    let size = config.project_size;
    let copied = tokio::select! {
        copied = docker.run(&words, COPY_TIMEOUT) => copied,
        () = outgrown(|| vec![(through.clone(), size << 20)]) => {
            let message = format!("The project in its image is larger than {size} MiB (projectSize)");
            return Err(Failure::new(Reason::ProjectTooLarge, message));
        }
    };
    if let Err(error) = copied {
        let instance = project.instance.path().to_owned();
        let full = on_thread(move || Ok(disk_fault(&instance, reserve))).await?;
        let why = match &error {
            DockerError::Slow { limit, .. } => format!("that takes longer than {} seconds", limit.as_secs()),
            _ => "its Dockerfile has to COPY the project there".to_owned(),
        };
        let otherwise = of_project(format!(
            "{} can't be copied out of the image of this project: {why}",
            from.display()
        ));
        return Err(match full {
            Some(failure) => failure,
            None => docker.explain(error, reserve, otherwise).await,
        });
    }
    docker.run(&[&REMOVE[..], &[&name]].concat(), SHORT_TIMEOUT).await?;
    let to = to.to_owned();
    on_thread(move || {
        remove_tree(&to)
            .and_then(|()| std::fs::rename(&through, &to))
            .map_err(|error| own_call_failed(&error))
    })
    .await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_keeps_its_entry_point_and_command_as_data() {
        let told =
            r#"{"User":"x\n\":7","Env":["A=b"],"Entrypoint":["/bin/sh","-c","a \\"],"Cmd":["b","\n"],"Volumes":null}"#;
        let image = BuiltImage::read("one".to_owned(), told).unwrap();
        let begin = ["/bin/sh", "-c", START_AT_HOME, "start-at-home"];
        assert_eq!(
            image.entrypoint(),
            [&begin[..], &["x\n\"", "/bin/sh", "-c", "a \\"]].concat()
        );
        assert_eq!(
            (image.name.as_str(), image.command()),
            ("one", vec!["b".to_owned(), "\n".to_owned()])
        );
        let at_home = |json| BuiltImage::read(String::new(), json).unwrap().entrypoint().pop();
        assert_eq!(at_home("{}").as_deref(), Some("root"));
        assert_eq!(
            at_home(r#"{"User":"x","Env":["HOME=/srv/x"]}"#).as_deref(),
            Some("/srv/x")
        );
    }

    #[test]
    fn an_image_that_keeps_data_is_refused() {
        let wrong = BuiltImage::read(String::new(), r#"{"Volumes":{"/data":{}}}"#).unwrap_err();
        assert!(wrong.contains("`VOLUME /data`"), "{wrong}");
    }
}
