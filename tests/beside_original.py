"""Plays the same class against a fleet of this project, of the Python servers, and of both; prints what rehearse finds.

    export ORIGINAL=FOLDER ORIGINAL_PYTHON=PYTHON
    tests/own_network.sh "$(tests/python.sh)" tests/beside_original.py [FLEET]... [-- ARGUMENT...]

ORIGINAL is the folder with session_server.py and simulation_server.py, ORIGINAL_PYTHON a Python with what they import
(tornado, psutil, pynvml, requests, distro). FLEET is one of those below (all); the ARGUMENTs for `rehearse` replace
those of CLASS. The Python servers listen on all interfaces: hence the network of its own.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "browser"))

from fleet import BIN, WORLD, Fleet, free_ports, until  # noqa: E402

SERVERS = 4
SLOTS = 5
CLASS = ["--clients", "200", "--over", "20s", "--stay", "5s..15s", "--patience", "4m", "--real-time", "0"]
KEY = "a secret of this measurement"
# The session server, the simulation servers, and whether the clients wait in the line.
FLEETS = {
    "ours": ("ours", ["ours"] * SERVERS, True),
    "original": ("original", ["original"] * SERVERS, False),
    "ours-behind-original": ("original", ["ours"] * SERVERS, False),
    "mixed": ("ours", ["ours"] * (SERVERS - 1) + ["original"], True),
}
# The load of a full machine, in percent. The Python session server takes a server for full from 95 on; ours is told a
# number that the load of this machine never reaches, since it has slots to go by.
FULL = {"original": 95, "ours": 150}
# The Python servers know no slots, only the load. Each simulation is a fifth of what its machine can do, as a heavy
# world is, so that the fifth one fills it.
LOAD = f"""
import psutil, runpy, sys
full = float(sys.argv.pop(1))
psutil.cpu_percent = lambda *_: full / {SLOTS} * len(psutil.Process().children())
sys.argv = sys.argv[1:]
sys.path.insert(0, {os.environ.get("ORIGINAL", "")!r})
runpy.run_path(sys.argv[0], run_name="__main__")
"""


class Beside(Fleet):
    """A fleet of servers of both kinds."""

    def __init__(self, session, simulations):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="fleet-beside-"))
        self.servers, self.others = [], []
        try:
            self.forge = self._forge()
            # The Python servers name repositories like this.
            self.full = FULL[session]
            (self.forge / "demo/worlds.git").symlink_to("worlds")
            addresses = [self.simulation(kind, number) for number, kind in enumerate(simulations)]
            config = {"port": free_ports(1), "simulationServers": addresses}
            if session == "ours":
                self.start("session-server", "session", {**config, "loadThreshold": self.full, "fleetKey": KEY})
            else:
                self.original("session_server.py", "session", config)
            self.url = f"http://127.0.0.1:{config['port']}"
        except BaseException:
            self.close()
            raise

    def simulation(self, kind, number):
        if kind == "ours":
            return self._simulation(f"ours{number}", {"maxConnections": SLOTS, "fleetKey": KEY}).address
        port = free_ports(SLOTS + 12)
        home = self.folder / "webots"
        home.mkdir(exist_ok=True)
        if not (home / "webots").exists():
            (home / "webots").symlink_to(BIN / "demo-simulator")
        allowed = ["https://github.com/demo"]
        config = {"port": port, "maxConnections": SLOTS, "webotsHome": str(home), "allowedRepositories": allowed}
        self.original("simulation_server.py", f"original{number}", {**config, "notify": []})
        return f"127.0.0.1:{port}"

    def original(self, program, name, config):
        folder = self.folder / name
        folder.mkdir()
        file = folder / "config.json"
        common = {"server": "127.0.0.1", "ssl": False, "portRewrite": False, "logDir": str(folder / "log")}
        file.write_text(json.dumps({**common, **config}))
        settings = folder / "gitconfig"
        settings.write_text(f'[url "file://{self.forge}/"]\n\tinsteadOf = https://git@github.com/\n')
        environment = {
            **os.environ,
            "DEMO_SIMULATOR_BIND": "127.0.0.1",
            "GIT_CONFIG_GLOBAL": str(settings),
            "PYTHONDONTWRITEBYTECODE": "1",
            # Its simulations are in one folder there.
            "TMPDIR": str(folder),
        }
        original = f"{os.environ['ORIGINAL']}/{program}"
        command = [os.environ["ORIGINAL_PYTHON"], "-c", LOAD, str(self.full), original, str(file)]
        with (folder / "output.txt").open("w") as log:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
        self.others.append(process)
        until(f"{program} answers", lambda: self.has_load(config["port"]))

    @staticmethod
    def has_load(port):
        answer = subprocess.run(["curl", "-sf", f"http://127.0.0.1:{port}/load"], capture_output=True, check=False)
        return answer.returncode == 0

    def close(self):
        for process in reversed(self.others):
            process.terminate()
        for process in self.others:
            process.wait()
        super().close()


def main(arguments):
    at = arguments.index("--") if "--" in arguments else len(arguments)
    for name in arguments[:at] or FLEETS:
        session, simulations, waits = FLEETS[name]
        print(f"\n## {name}\n", flush=True)
        with Beside(session, simulations) as fleet:
            line = ["--line"] if waits else []
            world = WORLD.format("playground")
            command = [BIN / "rehearse", fleet.url, "--world", world, *(arguments[at + 1 :] or CLASS), *line]
            subprocess.run(command, check=False)


main(sys.argv[1:])
