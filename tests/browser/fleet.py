"""A fleet for a class of tests: a session server, two simulation servers, the demo simulator, and git repositories.

Everything is on the loopback, in temporary folders; the programs come from the folder FLEET_BIN.
"""

import contextlib
import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request

ROOT = pathlib.Path(__file__).resolve().parents[2]
BIN = pathlib.Path(os.environ.get("FLEET_BIN", ROOT / "target/debug")).resolve()
# Timeout in seconds of what should happen soon; generous because the machine may be busy.
SOON = 60.0
WORLD = "https://github.com/demo/worlds/blob/main/worlds/{}.wbt"

# On SIGTERM from tests/run.sh, stops all servers, as on Ctrl-C.
signal.signal(signal.SIGTERM, signal.default_int_handler)


def free_ports(count):
    """The first of this many consecutive free ports."""
    start = 22_000 + os.getpid() % 100 * 100
    for first in list(range(start, 32_000, count)) + list(range(22_000, start, count)):
        try:
            for port in range(first, first + count):
                with socket.socket() as probe:
                    probe.bind(("0.0.0.0", port))
            return first
        except OSError:
            continue
    raise RuntimeError(f"no {count} free ports in a row")


def until(what, condition, patience=SOON):
    """Waits until a condition is true; returns its value."""
    begin = time.monotonic()
    while not (found := condition()):
        waited = time.monotonic() - begin
        if waited > patience:
            raise AssertionError(f"waited in vain until {what}")
        # The interval grows: each check of a page costs three programs milliseconds.
        time.sleep(min(max(waited / 10, 0.02), 0.25))
    return found


class Server:
    """A running program with its configuration and log."""

    def __init__(self, program, folder, config, environment):
        self.program, self.folder, self.port = program, folder, config["port"]
        folder.mkdir(parents=True, exist_ok=True)
        self.file = folder / "config.json"
        self.config = {
            "server": "127.0.0.1",
            "bind": "127.0.0.1",
            "ssl": False,
            "portRewrite": False,
            "debug": True,
            "logDir": str(folder / "log"),
            **config,
        }
        self.write()
        self.log = folder / "output.txt"
        environment = {**os.environ, "DEMO_SIMULATOR_BIND": "127.0.0.1", **environment}
        environment.pop("WEBOTS_HOME", None)
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                [BIN / program, self.file], stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment
            )
        until(f"{program} answers", self.answers)

    def write(self):
        self.file.write_text(json.dumps(self.config, indent=2))

    def reload(self, **changes):
        """Makes it reload its configuration with these values."""
        self.config.update(changes)
        self.write()
        self.process.send_signal(signal.SIGHUP)

    def answers(self):
        if self.process.poll() is not None:
            raise AssertionError(f"{self.program} has ended: {self.log.read_text()}")
        try:
            return self.get("health") == "ok"
        except (urllib.error.URLError, OSError):
            return False

    @property
    def address(self):
        return f"{self.config['bind']}:{self.port}"

    def url(self, path):
        return f"http://{self.address}/{path}"

    def get(self, path):
        with urllib.request.urlopen(self.url(path), timeout=SOON) as answer:
            return answer.read().decode()

    def status(self):
        return json.loads(self.get("status"))

    @contextlib.contextmanager
    def hanging(self):
        """Suspends it; its connections stay open."""
        self.process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self.process.send_signal(signal.SIGCONT)

    def kill(self):
        """Kills it without a warning, like a power failure."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self):
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(15)
            except subprocess.TimeoutExpired:
                self.kill()


class Client:
    """A web client of a simulation server, forwarded from this address, that sends a message and reads nothing."""

    def __init__(self, server, address, message):
        self.socket = socket.create_connection(("127.0.0.1", server.port))
        self.socket.sendall(
            (
                f"GET /client HTTP/1.1\r\nHost: {server.address}\r\nX-Forwarded-For: {address}\r\n"
                "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
            ).encode()
        )
        if b" 101 " not in self.socket.recv(4096):
            raise AssertionError("it is no WebSocket")
        text = json.dumps(message).encode()
        # A text frame with a mask of zeros: clients must mask.
        self.socket.sendall(bytes([0x81, 0x80 | 126]) + len(text).to_bytes(2, "big") + bytes(4) + text)

    def close(self):
        self.socket.close()


class Fleet:
    """The fleet; a context manager."""

    # Of its servers, besides this program's own.
    environment = {}

    def __init__(self, session=None, simulation=None, strangers=()):
        """Starts it; the arguments are further keys of the configurations, and addresses that don't answer."""
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="fleet-browser-"))
        self.servers = []
        try:
            self.forge = self._forge()
            simulation = simulation or {}
            self.simulation = self._simulation(
                "one",
                {
                    "title": "Demonstration",
                    "description": ("A simulation server that shows two small worlds."),
                    **simulation,
                },
            )
            self.other = self._simulation("two", {"title": "The other one", **simulation})
            self.session = self.start(
                "session-server",
                "session",
                {
                    "port": free_ports(1),
                    "simulationServers": [self.simulation.address, self.other.address, *strangers],
                    # Other load on this machine must not make the servers full.
                    "loadRefresh": 0.2,
                    "loadThreshold": 1000,
                    "examples": [
                        {"title": "Playground", "url": WORLD.format("playground")},
                        {"title": "Carousel", "url": WORLD.format("carousel")},
                    ],
                    **(session or {}),
                },
            )
            until("a simulation server is available", lambda: self.session.status()["available"])
        except BaseException:
            self.close()
            raise

    def _forge(self):
        """A folder that stands in for GitHub, with the demonstration's worlds in demo/worlds."""
        forge = self.folder / "forge"
        work = self.folder / "work"
        self._project(work)
        git = ["git", "-c", "user.name=Test", "-c", "user.email=test@localhost", "-c", "commit.gpgSign=false"]
        bare = forge / "demo/worlds"
        bare.mkdir(parents=True)
        for folder, *command in [
            (bare, "init", "--quiet", "--bare", "--initial-branch=main"),
            (work, "init", "--quiet", "--initial-branch=main"),
            (work, "add", "--all"),
            (work, "commit", "--quiet", "--message", "worlds"),
            (work, "push", "--quiet", str(bare), "main"),
        ]:
            subprocess.run([*git, *command], cwd=folder, check=True)
        return forge

    def _project(self, work):
        """Makes the folder with the worlds."""
        shutil.copytree(ROOT / "config/demo", work)
        (work / "worlds/textures").mkdir()
        (work / "worlds/textures/wood.png").write_text("a picture")
        # Fewer frames: without a GPU, most of the processor time is spent on drawing.
        for motion in work.glob("worlds/*.motion.json"):
            motion.write_text(json.dumps({**json.loads(motion.read_text()), "FPS": 2}))

    def _simulation(self, name, more):
        places = more.get("maxConnections", 4)
        port = more.get("port") or free_ports(places + 12)
        return self.start(
            "simulation-server",
            name,
            {
                "port": port,
                "maxConnections": places,
                "webots": str(BIN / "demo-simulator"),
                "environment": "DEMO_SIMULATOR_BIND",
                "cacheDir": str(self.folder / name / "cache"),
                "allowedRepositories": ["https://github.com/demo"],
                "gitMirrors": {"https://github.com/": f"file:{self.forge}"},
                **more,
            },
        )

    def start(self, program, name, config):
        """Starts a server, which is stopped with the fleet."""
        server = Server(program, self.folder / name, config, self.environment)
        self.servers.append(server)
        return server

    def close(self):
        for server in reversed(self.servers):
            server.stop()
        shutil.rmtree(self.folder, ignore_errors=True)

    def logs(self):
        return "\n".join(
            f"--- {server.program} {server.address} ---\n{server.log.read_text()}" for server in self.servers
        )

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if kind is not None:
            print(self.logs(), file=sys.stderr)
        self.close()
