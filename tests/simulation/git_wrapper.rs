//! A `git` that stands before the real one in the path: it notes each call, and can misbehave.

use crate::support::make_program;

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
        let (real, log) = (real.display(), folder.path().join("calls"));
        let note = format!("REAL={real}\necho \"$*\" >> {}", log.display());
        make_program(&folder.path().join("git"), &format!("{note}\n{script}\nexec \"$REAL\" \"$@\""));
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
