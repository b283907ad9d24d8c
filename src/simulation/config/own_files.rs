//! The files and directories of the configuration that belong to the server alone.

use std::path::Path;

use super::{IsolationSetting, SimulationConfig};
use crate::shared::config::{InvalidValueError, Secret, require};

impl SimulationConfig {
    /// Returns the files that may contain secrets: the configuration file, and those that it names.
    pub fn secret_files(&self) -> impl Iterator<Item = &Path> {
        let password = self.admin_password.as_ref().and_then(Secret::file);
        [Some(self.file.as_path()), self.git_config.as_ref().map(|file| &*file.0), password].into_iter().flatten()
    }

    /// Checks the key `sandbox`, if the isolation level uses it. Returns warnings.
    ///
    /// # Errors
    /// When it would break the sandbox.
    pub(super) fn check_sandbox(&self) -> Result<Vec<String>, InvalidValueError> {
        if !matches!(self.isolation, IsolationSetting::Auto | IsolationSetting::Sandbox) {
            let problem =
                "networks of simulations' own are for sandboxes, and isolation is neither \"sandbox\" nor \"auto\"";
            require(!self.sandbox.network.is_demanded(), "sandbox.network", || problem.to_owned())?;
            return Ok(Vec::new());
        }
        let own = [self.log_dir.0.as_path(), &self.cache_dir.0].into_iter().chain(self.secret_files());
        self.sandbox.check(own)
    }
}
