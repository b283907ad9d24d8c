//! A wrapper that comes before the real program in PATH: it records each call, and can misbehave.

use super::make_program;

/// A folder with the wrapper.
pub struct Wrapper {
    folder: tempfile::TempDir,
}

impl Wrapper {
    /// A wrapper of git that runs this script before each call; `$REAL` is the real git.
    pub fn git(script: &str) -> Self {
        Self::of("git", script)
    }

    /// A wrapper of this program.
    pub fn of(program: &str, script: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let paths = std::env::var_os("PATH").unwrap();
        let real = std::env::split_paths(&paths)
            .map(|folder| folder.join(program))
            .find(|path| path.is_file())
            .unwrap();
        let real = real.display();
        let log = folder.path().join("calls");
        let note = format!("REAL={real}\necho \"$*\" >> {}", log.display());
        make_program(
            &folder.path().join(program),
            &format!("{note}\n{script}\nexec \"$REAL\" \"$@\""),
        );
        Self { folder }
    }

    /// The value of PATH with the wrapper first.
    pub fn path(&self) -> String {
        format!("{}:{}", self.folder.path().display(), std::env::var("PATH").unwrap())
    }

    /// The arguments of each call so far.
    pub fn calls(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.folder.path().join("calls")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// The number of calls whose arguments contain this.
    pub fn count(&self, words: &str) -> usize {
        self.calls().iter().filter(|call| call.contains(words)).count()
    }
}
