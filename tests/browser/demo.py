"""The demo as a newcomer starts it: `./server.sh start demo`, in a copy of the project with its own ports."""

import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import tempfile

from fleet import BIN, ROOT, free_ports

# Timeout of every call of server.sh, in seconds.
LIMIT = 90
# The maximum number of simulation servers, and the ports reserved for each.
MOST, EACH = 3, 24


class Demo:
    """The running demo; a context manager."""

    def __init__(self, session=None, simulation=None, user=None):
        """Starts it, as the user with this id; the other arguments are further keys of its configuration."""
        self.become = ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups"] if user else []
        self.temporary = pathlib.Path(tempfile.mkdtemp(prefix="fleet-demo-"))
        self.folder = self.temporary / "webots-fleet"
        self.folder.mkdir()
        shutil.copy(ROOT / "server.sh", self.folder)
        shutil.copytree(ROOT / "config", self.folder / "config")
        # The build folder of server.sh.
        (self.folder / "target").mkdir()
        (self.folder / "target/release").symlink_to(BIN)
        # Each simulation server needs the ports that follow its own.
        port = free_ports(1 + MOST * EACH)
        self.ports = range(port, port + 1 + MOST * EACH)
        self.servers = 1
        self.session, self.simulation = f"localhost:{port}", f"localhost:{port + 1}"
        # Other load on this machine must not make the servers full.
        self.configure(
            "session",
            "demo",
            {"port": port, "simulationServers": [self.simulation], "loadThreshold": 1000, **(session or {})},
        )
        self.configure("simulation", "demo", {"port": port + 1, **(simulation or {})})
        if user:
            subprocess.run(["chown", "--recursive", f"{user}:{user}", self.temporary], check=True)
        try:
            self.started = self.server_sh("start", "demo")
        except BaseException:
            self.close()
            raise

    def configure(self, kind, name, more):
        """Makes a configuration from the demo's."""
        demo = json.loads((self.folder / f"config/{kind}/demo.json").read_text())
        (self.folder / f"config/{kind}/{name}.json").write_text(json.dumps({**demo, **more}))

    def add(self, name, title):
        """Starts one more simulation server, as if on another machine."""
        port = self.ports[1 + self.servers * EACH]
        self.servers += 1
        assert self.servers <= MOST, "there are no more ports"
        self.configure("simulation", name, {"port": port, "title": title, "cacheDir": f"cache/{name}"})
        addresses = [f"localhost:{self.ports[1 + number * EACH]}" for number in range(self.servers)]
        self.configure("session", "demo", {"simulationServers": addresses})
        self.server_sh("start", name)
        os.kill(self.process("session"), signal.SIGHUP)

    def server_sh(self, *arguments):
        """Runs server.sh, which must succeed; returns its output."""
        done = subprocess.run(
            [*self.become, self.folder / "server.sh", *arguments],
            check=False,
            env={**os.environ, "FLEET_BIN": str(BIN)},
            timeout=LIMIT,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
        )
        if done.returncode != 0:
            raise AssertionError(f"server.sh {arguments}: {done.returncode}\n{done.stdout}{done.stderr}{self.logs()}")
        return done.stdout

    def process(self, kind):
        return int((self.folder / f"log/{kind}/demo.pid").read_text())

    def leftovers(self):
        """What is left of it: processes, PID files, folders of runs, ports."""
        left = [str(path) for path in [*self.folder.glob("log/*/*.pid"), *self.folder.glob("cache/runs/*")]]
        for process in pathlib.Path("/proc").glob("[0-9]*"):
            try:
                if (process / "cwd").resolve(strict=True).is_relative_to(self.folder):
                    left.append(f"process {process.name} {(process / 'cmdline').read_text()}")
            except OSError:
                continue
        for port in self.ports:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    left.append(f"port {port}")
        return left

    def logs(self):
        files = [path for path in sorted(self.folder.glob("log/**/*")) if path.is_file()]
        return "\n".join(f"--- {path.name} ---\n{path.read_text()}" for path in files)

    def close(self):
        try:
            self.server_sh("stop")
        finally:
            shutil.rmtree(self.temporary, ignore_errors=True)

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if kind is not None:
            print(self.logs(), file=sys.stderr)
        self.close()
