//! Apache and nginx as child processes, with configurations of their own.

use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill, killpg};
use nix::unistd::{Pid, Uid};

use crate::support::{holds_soon, until};

/// The program.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    Apache,
    Nginx,
}

/// A web server, killed on drop; its error log is printed if the test fails.
pub struct WebServer {
    kind: Kind,
    child: Option<Child>,
    folder: tempfile::TempDir,
    port: u16,
}

const MODULES: &[&str] = &[
    "mpm_event",
    "authz_core",
    "ssl",
    "alias",
    "headers",
    "rewrite",
    "reqtimeout",
    "proxy",
    "proxy_http",
    "proxy_wstunnel",
];

impl WebServer {
    /// Starts a web server with a site's rules; `idle` is its default idle timeout.
    pub async fn start(kind: Kind, ports: (u16, u16), site: &str, idle: Duration) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let here = folder.path().to_str().unwrap();
        let site = site.replace("/var/log/nginx", here).replace("${APACHE_LOG_DIR}", here);
        std::fs::write(folder.path().join("site.conf"), site).unwrap();
        let main = match kind {
            Kind::Apache => apache_conf(folder.path(), ports, idle),
            Kind::Nginx => nginx_conf(folder.path(), idle),
        };
        std::fs::write(folder.path().join("main.conf"), main).unwrap();
        let mut server = Self {
            kind,
            child: None,
            folder,
            port: ports.1,
        };
        server.go().await;
        server
    }

    fn program(&self) -> &'static str {
        match self.kind {
            Kind::Apache => "/usr/sbin/apache2",
            Kind::Nginx => "/usr/sbin/nginx",
        }
    }

    /// Starts the program, which must not be running.
    pub async fn go(&mut self) {
        let program = self.program();
        assert!(
            Path::new(program).exists(),
            "this test needs Debian's web servers, and {program} is missing: apt install apache2-bin nginx"
        );
        let conf = self.folder.path().join("main.conf");
        let output = std::fs::File::options()
            .create(true)
            .append(true)
            .open(self.error_log())
            .unwrap();
        let mut command = Command::new("setpriv");
        // It ends even if this process is killed.
        command.args(["--pdeathsig", "TERM", program]);
        match self.kind {
            Kind::Apache => command.arg("-f").arg(&conf).arg("-DFOREGROUND"),
            Kind::Nginx => command.arg("-c").arg(&conf).arg("-e").arg(self.error_log()),
        };
        let child = command
            .process_group(0)
            .stdin(Stdio::null())
            .stdout(output.try_clone().unwrap())
            .stderr(output)
            .spawn();
        let child = child.expect("this test needs setpriv: apt install util-linux");
        self.child = Some(child);
        let listens = holds_soon(async || {
            let ended = self.child.as_mut().unwrap().try_wait().unwrap();
            assert!(ended.is_none(), "{program} has ended: {}", self.log());
            std::net::TcpStream::connect(("127.0.0.1", self.port)).is_ok()
        });
        assert!(listens.await, "{program} does not listen: {}", self.log());
    }

    /// Makes it reload its configuration, as after the renewal of a certificate.
    pub fn reload(&self) {
        let signal = if self.kind == Kind::Apache {
            Signal::SIGUSR1
        } else {
            Signal::SIGHUP
        };
        kill(self.pid(), signal).unwrap();
    }

    /// Stops the program and waits until it has ended, which closes its connections.
    pub async fn stop(&mut self) {
        kill(self.pid(), Signal::SIGTERM).unwrap();
        let child = self.child.as_mut().unwrap();
        until("the web server has ended", async || child.try_wait().unwrap().is_some()).await;
        self.child = None;
    }

    pub fn pid(&self) -> Pid {
        Pid::from_raw(i32::try_from(self.child.as_ref().unwrap().id()).unwrap())
    }

    fn error_log(&self) -> PathBuf {
        self.folder.path().join("error.log")
    }

    /// The requests that it has logged.
    pub fn access_log(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("access.log")).unwrap_or_default()
    }

    /// Its error log.
    pub fn log(&self) -> String {
        std::fs::read_to_string(self.error_log()).unwrap_or_default()
    }
}

impl Drop for WebServer {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            // Kills the process group: on SIGTERM, Apache takes ten seconds while connections are open.
            killpg(Pid::from_raw(i32::try_from(child.id()).unwrap()), Signal::SIGKILL).ok();
            child.wait().ok();
        }
        if std::thread::panicking() {
            eprintln!("--- {} ---\n{}---", self.program(), self.log());
        }
    }
}

fn apache_conf(folder: &Path, (http, https): (u16, u16), idle: Duration) -> String {
    let modules: String = MODULES
        .iter()
        .map(|name| format!("LoadModule {name}_module /usr/lib/apache2/modules/mod_{name}.so\n"))
        .collect();
    let folder = folder.display();
    let idle = idle.as_secs();
    let user = if Uid::effective().is_root() {
        "User www-data\nGroup www-data\n"
    } else {
        ""
    };
    format!(
        "{modules}ServerRoot {folder}\nDefaultRuntimeDir {folder}\nPidFile {folder}/pid\nErrorLog {folder}/error.log\n\
         LogLevel warn\nLogFormat \"%r\" combined\nServerName localhost\n{user}\
         StartServers 1\nServerLimit 4\nThreadsPerChild 25\nMaxRequestWorkers 100\n\
         Timeout {idle}\nRequestReadTimeout header=1,MinRate=500 body=1,MinRate=500\n\
         Listen 127.0.0.1:{http}\nListen 127.0.0.1:{https}\nInclude {folder}/site.conf\n"
    )
}

fn nginx_conf(folder: &Path, idle: Duration) -> String {
    let folder = folder.display();
    let idle = idle.as_secs();
    let user = if Uid::effective().is_root() { "user root;\n" } else { "" };
    let temporary: String = ["client_body", "proxy", "fastcgi", "uwsgi", "scgi"]
        .iter()
        .fold(String::new(), |text, name| {
            text + &format!("  {name}_temp_path {folder}/{name};\n")
        });
    format!(
        "{user}daemon off;\nworker_processes 1;\npid {folder}/pid;\nerror_log {folder}/error.log warn;\n\
         events {{ worker_connections 512; }}\n\
         http {{\n{temporary}  access_log off;\n  client_header_timeout {idle}s;\n  client_body_timeout {idle}s;\n\
         send_timeout {idle}s;\n  proxy_read_timeout {idle}s;\n  proxy_send_timeout {idle}s;\n\
         include {folder}/site.conf;\n}}\n"
    )
}
