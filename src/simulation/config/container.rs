//! The key `container`: how simulations run in containers.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::shared::config::keys::keys;
use crate::shared::config::{OneOrMany, Whole};

keys! {
/// How simulations run in containers.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "camelCase", default, deny_unknown_fields)]
pub struct ContainerSettings {
    /// The image of Webots for a world whose project has no Dockerfile. `{version}` is that of the world, such as R2023b,
    /// `{ubuntu}` the Ubuntu version of its image. Default: `cyberbotics/webots.cloud:{version}-ubuntu{ubuntu}`.
    pub image: String = "cyberbotics/webots.cloud:{version}-ubuntu{ubuntu}".to_owned(),
    /// The image of the editor that a project may request. Default: that of the original.
    pub editor_image: String = "benjamindeleze/theia-test:test3".to_owned(),
    /// Webots' launcher in the image. Default: `webots`.
    pub program: String = "webots".to_owned(),
    /// The display of Webots: a virtual one inside (`xvfb-run` of its image), or that of the machine. Default: virtual.
    pub display: ContainerDisplay = ContainerDisplay::default(),
    /// The network that containers reach. Default: internet.
    pub network: ContainerNetwork = ContainerNetwork::default(),
    /// Whether containers get the GPUs of the machine, if it has any. Default: true.
    pub gpu: bool = true,
    /// Whether the files of the image are read-only. Default: true.
    pub read_only: bool = true,
    /// Whether programs may gain privileges, as `sudo` does. Default: false.
    pub new_privileges: bool = false,
    /// Linux capabilities that containers keep, such as `SYS_PTRACE`. Default: none.
    #[serde(with = "OneOrMany::<String>")]
    pub capabilities: Vec<String> = Vec::new(),
    /// Directories of the machine that are mounted in containers, as `FOLDER:PATH` or `FOLDER:PATH:ro`. Default: none.
    #[serde(with = "OneOrMany::<String>")]
    pub mounts: Vec<String> = Vec::new(),
    /// Images that are built or pulled at a time; for one address one less, if there are several. Default: 3.
    #[serde(with = "Whole::<1, 1000>")]
    pub builds: usize = 3,
    /// Maximum size of a project's image with the image that it begins with, in MiB. Default: 16384.
    #[serde(with = "Whole::<1, 100_000_000>")]
    pub image_size: u64 = 16_384,
    /// Maximum size of all images that this server has built or pulled, in MiB. Default: 65536.
    #[serde(with = "Whole::<1, 100_000_000>")]
    pub images_size: u64 = 65_536,
    /// Days without use after which an image that this server has built or pulled is removed, unless a container uses it.
    /// Default: 14.
    #[serde(with = "Whole::<1, 10_000>")]
    pub images_age: u64 = 14,
}
}

/// The display of Webots in its container.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ContainerDisplay {
    /// A virtual display.
    #[default]
    Virtual,
    /// That of the machine, as in the original: each simulation on it can read, and type into, the windows of others.
    Machine,
}

/// The network that containers reach.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ContainerNetwork {
    /// The internet, without private addresses and the machine itself.
    #[default]
    Internet,
    /// No network. Clients still reach Webots.
    Closed,
}

/// Offset from the port of a Webots to the port of its editor, as the original's page expects.
pub const EDITOR_PORT: u16 = 500;

impl ContainerNetwork {
    /// The name of the Docker network, and of its interface, which the packet filter matches.
    pub fn name(self) -> &'static str {
        match self {
            Self::Internet => "webots-fleet",
            Self::Closed => "webots-closed",
        }
    }
}
