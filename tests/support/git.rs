//! Real git repositories in a folder of the test, in place of a Git host.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// A folder of bare repositories: `repositories/lab/arm` is the mirror of `https://github.com/lab/arm`.
pub struct Forge {
    folder: tempfile::TempDir,
}

/// A world that the demo simulator can show.
pub const WORLD: &str = "#VRML_SIM R2025a utf8\nWorldInfo { title \"Test\" basicTimeStep 32 }\nViewpoint { position -4 0 2 }\n\
                         Robot { name \"one\" translation 0 0 0.1 children [ Shape { geometry Box { size 0.1 0.1 0.1 } } ] }\n";

impl Forge {
    pub fn new() -> Self {
        Self {
            folder: super::open_folder(),
        }
    }

    /// A forge with `lab/arm`, whose branch `main` has `worlds/a.wbt` and a controller.
    pub fn with_arm() -> Self {
        let forge = Self::new();
        forge.commit(
            "lab/arm",
            "main",
            &[("worlds/a.wbt", WORLD), ("controllers/c/c.py", "print('original')\n")],
        );
        forge
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Commits these files to a branch, which is created from `main` if necessary; returns the commit's hash.
    pub fn commit(&self, repository: &str, branch: &str, files: &[(&str, &str)]) -> String {
        let bare = self.bare(repository);
        let mut stream =
            format!("commit refs/heads/{branch}\nmark :1\ncommitter Test <test@localhost> now\ndata 4\ntest\n");
        if let Some(parent) = [branch, "main"]
            .map(|name| format!("refs/heads/{name}"))
            .iter()
            .find(|name| exists(&bare, name))
        {
            stream += &format!("from {parent}^0\n");
        }
        for (path, text) in files {
            stream += &format!("M 644 inline {path}\ndata {}\n{text}\n", text.len());
        }
        stream += "get-mark :1\n";
        let mut import = Command::new("git")
            .current_dir(&bare)
            .args(["fast-import", "--quiet", "--date-format=now"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        import.stdin.take().unwrap().write_all(stream.as_bytes()).unwrap();
        let output = import.wait_with_output().unwrap();
        assert!(output.status.success(), "{stream}");
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    /// A repository, created if necessary.
    fn bare(&self, repository: &str) -> PathBuf {
        let bare = self.folder.path().join(repository);
        if !bare.exists() {
            std::fs::create_dir_all(&bare).unwrap();
            git(
                &bare,
                &["init", "--quiet", "--bare", "--template=", "--initial-branch=main"],
            );
        }
        bare
    }

    /// A checkout of a branch, to change before [`Forge::commit_work_tree`].
    pub fn work_tree(&self, repository: &str, branch: &str) -> PathBuf {
        let bare = self.bare(repository);
        let work = self.folder.path().join(".work").join(repository);
        if !work.exists() {
            git(
                self.folder.path(),
                &["clone", "--quiet", bare.to_str().unwrap(), work.to_str().unwrap()],
            );
        }
        if exists(&bare, &format!("refs/heads/{branch}")) {
            git(&work, &["fetch", "--quiet", "origin"]);
            git(
                &work,
                &["checkout", "--quiet", "-B", branch, &format!("origin/{branch}")],
            );
        } else {
            git(&work, &["checkout", "--quiet", "-B", branch]);
        }
        work
    }

    /// Commits and pushes everything in the checkout.
    pub fn commit_work_tree(&self, repository: &str, branch: &str) -> String {
        let work = self.folder.path().join(".work").join(repository);
        git(&work, &["add", "--all"]);
        git(&work, &["commit", "--quiet", "--allow-empty", "--message", "test"]);
        git(
            &work,
            &[
                "push",
                "--quiet",
                "--force",
                "origin",
                &format!("{branch}:refs/heads/{branch}"),
            ],
        );
        git(&work, &["rev-parse", "HEAD"]).trim().to_owned()
    }

    /// Adds a commit to `main` with this many bytes that git can't compress.
    pub fn commit_noise(&self, repository: &str, bytes: usize) {
        let mut noise = vec![0; bytes];
        rand::fill(&mut noise[..]);
        std::fs::write(self.work_tree(repository, "main").join(format!("noise{bytes}")), noise).unwrap();
        self.commit_work_tree(repository, "main");
    }

    /// Tags the head of a branch.
    pub fn tag(&self, repository: &str, name: &str, branch: &str) {
        git(
            &self.bare(repository),
            &["tag", "--annotate", "--message", "test", name, branch],
        );
    }
}

/// Whether a repository has a reference.
fn exists(bare: &Path, reference: &str) -> bool {
    let asked = Command::new("git")
        .current_dir(bare)
        .args(["show-ref", "--quiet", "--verify", reference])
        .status();
    asked.unwrap().success()
}

/// The URL of a world.
pub fn world(repository: &str, reference: &str, path: &str) -> String {
    format!("https://github.com/{repository}/blob/{reference}/{path}")
}

/// The URL of the world of [`Forge::with_arm`].
pub fn arm() -> String {
    arm_at("main")
}

/// The URL of that world at a branch, tag or commit.
pub fn arm_at(reference: &str) -> String {
    world("lab/arm", reference, "worlds/a.wbt")
}

/// Runs git in a folder; returns its output.
pub fn git(folder: &Path, arguments: &[&str]) -> String {
    let fixed = [
        "-c",
        "user.name=Test",
        "-c",
        "user.email=test@localhost",
        "-c",
        "commit.gpgSign=false",
    ];
    let output = Command::new("git")
        .current_dir(folder)
        .args(fixed)
        .args(arguments)
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "git {arguments:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}
