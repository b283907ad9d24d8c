//! A `git` that stands before the real one in the path: it notes each call, and can misbehave.

use std::os::unix::fs::PermissionsExt;

/// A folder with the wrapper.
pub struct GitWrapper {
    folder: tempfile::TempDir,
}

impl GitWrapper {
    /// Runs this script before each call; `$REAL` is the real git.
    pub fn new(script: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let paths = std::env::var_os("PATH").unwrap();
        let real = std::env::split_paths(&paths).map(|folder| folder.join("git")).find(|path| path.is_file()).unwrap();
        let (file, log) = (folder.path().join("git"), folder.path().join("calls"));
        let text = format!(
            "#!/usr/bin/env bash\nREAL={}\necho \"$*\" >> {}\n{script}\nexec \"$REAL\" \"$@\"\n",
            real.display(),
            log.display()
        );
        std::fs::write(&file, text).unwrap();
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o755)).unwrap();
        Self { folder }
    }

    /// The variable PATH with the wrapper first.
    pub fn path(&self) -> String {
        format!("{}:{}", self.folder.path().display(), std::env::var("PATH").unwrap())
    }

    /// The arguments of each call until now.
    pub fn calls(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.folder.path().join("calls")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }
}
