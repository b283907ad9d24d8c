"""Apache and nginx as child processes, with configurations of their own and a certificate for localhost."""

import os
import re
import shutil
import signal
import subprocess

import trustme
from fleet import until

# On Debian, web servers are in /usr/sbin, which only root has in its PATH.
PROGRAMS = {name: shutil.which(name) or f"/usr/sbin/{name}" for name in ("nginx", "apache2")}
MODULES = [
    *["alias", "authz_core", "deflate", "dir", "filter", "headers", "mime", "proxy", "proxy_http", "proxy_wstunnel"],
    *["reqtimeout", "rewrite", "setenvif", "ssl"],
]


def adapted(text, **changes):
    """Adapts rules to this machine; the text must contain each pattern."""
    for what, (pattern, replacement) in changes.items():
        text, count = re.subn(pattern, lambda _: replacement, text, flags=re.DOTALL)
        assert count, f"{what}: {pattern} is not in {text}"
    return text


class WebServer:
    """A web server whose files are in a folder of its own: the `chain` and `key` of its certificate, and the
    certificate of the `authority` that has issued it."""

    def __init__(self, program, folder, names=("localhost",)):
        self.program, self.folder, self.process = program, folder, None
        folder.mkdir()
        # Apache's workers are another user.
        folder.chmod(0o755)
        issuer = trustme.CA()
        certificate = issuer.issue_cert(*names)
        self.chain, self.key, self.authority = (folder / f"{name}.pem" for name in ("chain", "key", "authority"))
        certificate.cert_chain_pems[0].write_to_path(self.chain)
        certificate.private_key_pem.write_to_path(self.key)
        issuer.cert_pem.write_to_path(self.authority)

    def start(self, site, ports=(), modules=("mpm_event",)):
        """Starts it with the rules of a site; Apache also takes its ports, and modules besides the usual ones."""
        (self.folder / "site.conf").write_text(site)
        main = self._nginx() if self.program == "nginx" else self._apache(ports, modules)
        (self.folder / "main.conf").write_text(main)
        files = ["-f" if self.program == "apache2" else "-c", self.folder / "main.conf"]
        more = ["-DFOREGROUND"] if self.program == "apache2" else ["-e", self.folder / "error.log"]
        with (self.folder / "output.txt").open("w") as output:
            self.process = subprocess.Popen(
                [PROGRAMS[self.program], *files, *more],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                process_group=0,
            )
        until("the web server runs", lambda: (self.folder / "pid").exists() or self.process.poll() is not None)
        if self.process.poll() is not None:
            raise AssertionError(f"{self.program} has ended: {self.logs()}")

    def _nginx(self):
        folder = self.folder
        temporary = "".join(
            f"{name}_temp_path {folder}/{name};\n" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        )
        return (
            f"user root;\ndaemon off;\nworker_processes 1;\npid {folder}/pid;\nerror_log {folder}/error.log warn;\n"
            f"events {{ worker_connections 1024; }}\nhttp {{\n{temporary}include {folder}/site.conf;\n}}\n"
        )

    def _apache(self, ports, modules):
        folder = self.folder
        loaded = "".join(
            f"LoadModule {name}_module /usr/lib/apache2/modules/mod_{name}.so\n" for name in (*modules, *MODULES)
        )
        user = "User www-data\nGroup www-data\n" if os.geteuid() == 0 else ""
        listen = "".join(f"Listen 127.0.0.1:{port}\n" for port in ports)
        return (
            f"{loaded}ServerRoot {folder}\nDefaultRuntimeDir {folder}\nPidFile {folder}/pid\n"
            f"ErrorLog {folder}/error.log\n"
            f'LogLevel warn\nLogFormat "%r" combined\nServerName localhost\n{user}TypesConfig /etc/mime.types\n'
            f"{listen}Include {folder}/site.conf\n"
        )

    def logs(self):
        files = [self.folder / name for name in ("output.txt", "error.log", "access.log")]
        return "".join(f"\n--- {file.name} ---\n{file.read_text()}" for file in files if file.exists())

    def stop(self):
        """Kills its process group: on SIGTERM, Apache takes ten seconds while connections are open."""
        if self.process is not None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self.process = None
