"""Runs worlds in a Webots through a fleet; see `tests/real-webots.sh`."""

import argparse
import base64
import json
import os
import pathlib
import platform
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "browser"))

from fleet import SOON, Fleet, until  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

# A real world has to be read, and its assets downloaded.
START = 600.0
# Wall time over which the speed is measured, in seconds.
SPAN = 3.0
COLUMNS = (
    "isolation",
    "stream",
    "world",
    "ready s",
    "moving s",
    "real-time factor",
    "reset",
    "robot windows",
    "memory MB",
    "watched",
    "resumed s",
    "end s",
    "stopped s",
    "crashed s",
    "server's end s",
    "result",
)
LEVELS = ("none", "sandbox", "container")
PASSWORD = "a secret"
REASON = "The lesson is over"


class Failed(Exception):
    """What was not as expected."""


class OneWorld(Fleet):
    """A fleet for the world of a project."""

    def __init__(self, world, keys):
        self.world = world
        super().__init__(simulation=keys)

    def _project(self, work):
        project = self.world.parent.parent if self.world.parent.name == "worlds" else self.world.parent
        shutil.copytree(project, work, ignore=shutil.ignore_patterns(".git"))

    @property
    def url(self):
        folder = "worlds/" if self.world.parent.name == "worlds" else ""
        return f"https://github.com/demo/worlds/blob/main/{folder}{self.world.name}"


def first(socket, timeout, what, chosen):
    """What `chosen` makes of the first text of a WebSocket for which that is not `None`."""
    end = time.monotonic() + timeout
    while (left := end - time.monotonic()) > 0:
        try:
            found = chosen(socket.recv(left))
        except TimeoutError:
            break
        if found is not None:
            return found
    raise Failed(f"{what} did not come within {timeout:.0f} s")


def until_text(socket, text):
    first(socket, SOON, f"`{text}`", lambda heard: True if heard == text else None)


def simulations(server):
    """The simulations of a server, as its administrator sees them."""
    return json.loads(as_administrator(server, "status"))["simulations"]


class Ready:
    """What a client is told of its simulation until that is ready."""

    def __init__(self, client):
        self.kind, self.token, self.url = "w3d", None, None
        first(client, START, "webots: and resume:", self._hears)

    def _hears(self, text):
        if text.startswith(("error:", "Error:", "loading: Error:")):
            raise Failed(text.split("\n")[0])
        name, _, value = text.partition(":")
        if name == "kind":
            self.kind = value.strip()
        elif name == "resume":
            self.token = value.strip()
        elif name == "webots":
            self.url = value
        return self if self.url and self.token else None


def as_administrator(server, path, body=None):
    """The text of a page, or the answer to an action, of an administrator."""
    credentials = base64.b64encode(f"admin:{PASSWORD}".encode()).decode()
    request = urllib.request.Request(
        server.url(path),
        data=None if body is None else json.dumps(body).encode(),
        headers={"Authorization": f"Basic {credentials}", "Content-Type": "application/json"},
    )
    with urllib.request.urlopen(request, timeout=SOON) as answer:
        return answer.read().decode()


def update(text):
    """The content of an update; empty if it is another text."""
    kind, _, content = text.partition("application/json:")
    return json.loads(content) if not kind and content else {}


def moved(stream):
    """Waits until a node has moved; returns the simulation time in milliseconds."""
    seen = {}

    def chosen(text):
        frame = update(text)
        poses = {node["id"]: (node.get("translation"), node.get("rotation")) for node in frame.get("updates", [])}
        known = {node: seen.setdefault(node, pose) for node, pose in poses.items()}
        return frame["time"] if known != poses else None

    return first(stream, SOON, "a movement", chosen)


def speed(stream, begin):
    """The simulated time per wall time."""
    started = time.monotonic()

    def chosen(text):
        passed = time.monotonic() - started
        return (update(text)["time"] - begin) / 1000 / passed if passed > SPAN and "time" in update(text) else None

    return first(stream, SPAN + SOON, "time", chosen)


def memory(server):
    """What the server reads as the simulation's memory, in MB: of its processes, or of its containers."""

    def reading():
        cell = re.search('data-label="Memory"[^>]*data-value="([0-9]+)"', as_administrator(server, "monitor"))
        return int(cell[1]) if cell else 0

    return until("its memory is read", reading) >> 20


def windows(ready, stream):
    """The number of robot windows in the scene, whose pages are there."""
    names = []
    first(stream, SOON, "the scene", lambda text: has_ended_with(text, names))
    for name in names:
        page = f"{ready.url.replace('ws', 'http', 1)}/robot_windows/{name}/{name}.html"
        with urllib.request.urlopen(page, timeout=SOON) as answer:
            if not answer.read():
                raise Failed(f"the page of the window {name} is empty")
    return len(names)


def has_ended_with(text, names):
    """Whether the scene ends with this text; collects the names of the robots' windows."""
    kind, _, window = text.partition("robot window: ")
    if not kind and window:
        names.append(json.loads(window)["window"])
    return text == "scene load completed" or None


def runs(ready, row, begin):
    """Lets the simulation run and resets it."""
    with connect(f"{ready.url}/", max_size=None) as stream:
        stream.send(ready.kind)
        row["robot windows"] = windows(ready, stream)
        stream.send("real-time:-1")
        now = moved(stream)
        row["moving s"] = f"{time.monotonic() - begin:.1f}"
        row["real-time factor"] = f"{speed(stream, now):.2f}"
        stream.send("reset")
        until_text(stream, "reset finished")
        stream.send("real-time:-1")
        if moved(stream) > now + 1000 * SPAN:
            raise Failed("the time goes on after a reset")
        row["reset"] = "yes"


def is_watched(server, simulation, kind, client):
    """An administrator sees the scene, and the client is told so."""
    page = as_administrator(server, f"watch?id={simulation['id']}")
    path = re.search('data-stream="([^"]+)"', page)[1]
    with connect(f"ws://{server.address}/{path}", max_size=None) as watcher:
        watcher.send(f"{kind};broadcast")
        until_text(watcher, "scene load completed")
        until_text(client, "watched: 1")
    until_text(client, "watched: 0")


def is_resumed(server, client, token, simulation):
    """The client comes back to its simulation, whose Webots has gone on."""
    client.send(json.dumps({"resume": token}))
    first(client, SOON, "webots:", lambda text: text.startswith("webots:") or None)
    if simulations(server)[0]["pid"] != simulation["pid"]:
        raise Failed("another Webots was started")


def runs_nothing(server):
    try:
        return not simulations(server)
    except OSError:
        return server.process.poll() is not None


def has_ended(server, simulation, begin):
    """The seconds until nothing of the simulation is left."""
    until("the simulation has ended", lambda: runs_nothing(server))
    until("its process has ended", lambda: not pathlib.Path(f"/proc/{simulation['pid']}").exists())
    return f"{time.monotonic() - begin:.1f}"


def student(fleet, row):
    """A student's way: starts, plays, is watched, loses the connection, leaves."""
    server = fleet.simulation
    begin = time.monotonic()
    with connect(f"ws://{server.address}/client", max_size=None) as client:
        client.send(json.dumps({"start": {"url": fleet.url, "resumable": True}}))
        ready = Ready(client)
        row["ready s"] = f"{time.monotonic() - begin:.1f}"
        (simulation,) = simulations(server)
        runs(ready, row, begin)
        row["memory MB"] = memory(server)
        is_watched(server, simulation, ready.kind, client)
        row["watched"] = "yes"
        # The connection is lost without a word.
        client.socket.shutdown(socket.SHUT_RDWR)
    until("the server has noticed", lambda: "awayUntil" in simulations(server)[0])
    begin = time.monotonic()
    with connect(f"ws://{server.address}/client", max_size=None) as client:
        is_resumed(server, client, ready.token, simulation)
        row["resumed s"] = f"{time.monotonic() - begin:.1f}"
        begin = time.monotonic()
    row["end s"] = has_ended(server, simulation, begin)


def ended(fleet, stream_kind, reason, end):
    """The seconds in which a simulation ends: its client is told why, and a relay closes its stream with 1000."""
    server = fleet.simulation
    with connect(f"ws://{server.address}/client", max_size=None) as client:
        client.send(json.dumps({"start": {"url": fleet.url, "resumable": True}}))
        ready = Ready(client)
        (simulation,) = simulations(server)
        with connect(f"{ready.url}/", max_size=None) as stream:
            stream.send(ready.kind)
            until_text(stream, "scene load completed")
            begin = time.monotonic()
            end(server, simulation)
            first(client, SOON, f"the reason {reason}", lambda text: f'"{reason}"' in text or None)
            try:
                first(stream, SOON, "the end of the stream", lambda _: None)
            except ConnectionClosed as closed:
                code = closed.rcvd.code if closed.rcvd else 1006
            # A crash is no end that anybody wanted.
            if stream_kind == "relay" and (code == 1000) != (reason != "crashed"):
                raise Failed(f"{reason}: the stream has ended with {code}") from None
    return has_ended(server, simulation, begin)


def stop(server, simulation):
    as_administrator(server, f"simulations/{simulation['id']}/stop", {"reason": REASON})


def crash(_, simulation):
    os.kill(simulation["pid"], signal.SIGKILL)


def end_server(server, _):
    server.process.terminate()


def tried(isolation, streaming, world, arguments):
    """A row of the table."""
    row = {"isolation": isolation, "stream": streaming, "world": world.stem, "result": "ok"}
    keys = {"isolation": isolation, "streaming": streaming, "adminPassword": PASSWORD}
    if isolation == "container":
        # The program is that of the image.
        keys |= {"webots": None, "container": {"image": image(world, arguments)}}
    elif arguments.program:
        keys["webots"] = arguments.program
    else:
        home = os.environ["WEBOTS_HOME"]
        keys |= {"webotsHome": home, "webots": f"{home}/webots"}
    try:
        with OneWorld(world, keys) as fleet:
            student(fleet, row)
            row["stopped s"] = ended(fleet, streaming, "stopped-by-administrator", stop)
            if isolation != "container":
                # There the process is that of Docker.
                row["crashed s"] = ended(fleet, streaming, "crashed", crash)
            row["server's end s"] = ended(fleet, streaming, "server-stopped", end_server)
    except (Failed, AssertionError, OSError, ConnectionClosed) as error:
        row["result"] = str(error).split("\n")[0][:120]
    return row


def image(world, arguments):
    """The image in which a world runs: by default the one that a server takes for its release."""
    release = world.read_text().split()[1]
    return arguments.image or f"cyberbotics/webots.cloud:{release}-ubuntu{'20.04' if release < 'R2023b' else '22.04'}"


def docker(*command):
    return subprocess.run(["docker", *command], capture_output=True, check=False).returncode == 0


def missing(isolation, worlds, arguments):
    """What this machine lacks for this level; empty if nothing."""
    if isolation == "sandbox" and not shutil.which("bwrap"):
        return "there is no bwrap"
    if isolation != "container":
        return ""
    if arguments.program and not arguments.image:
        return "--image names no image with that program"
    if not shutil.which("docker") or not docker("version"):
        return "there is no Docker, or this user may not use it"
    images = sorted({image(world, arguments) for world in worlds})
    absent = [one for one in images if not docker("image", "inspect", one)]
    return "; ".join(f"docker pull {one}" for one in absent)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--program")
    parser.add_argument("--image")
    parser.add_argument("--isolation", choices=LEVELS)
    parser.add_argument("worlds", nargs="*")
    arguments = parser.parse_args()
    worlds = [pathlib.Path(world).resolve() for world in arguments.worlds]
    worlds = worlds or sorted((HERE / "project/worlds").glob("*.wbt"))
    levels = [arguments.isolation] if arguments.isolation else LEVELS
    lacks = {isolation: missing(isolation, worlds, arguments) for isolation in levels}
    rows = [
        tried(isolation, streaming, world, arguments)
        for isolation in levels
        for streaming in ("direct", "relay")
        for world in worlds
        if not lacks[isolation]
    ]
    print(f"\n{arguments.program or os.environ['WEBOTS_HOME']}, {platform.platform()}, {os.cpu_count()} cores\n")
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for row in rows:
        print(f"| {' | '.join(str(row.get(column, '-')) for column in COLUMNS)} |")
    for isolation, what in lacks.items():
        if what:
            print(f"\nNot tried: {isolation}: {what}")
    return not rows or any(row["result"] != "ok" for row in rows)


if __name__ == "__main__":
    sys.exit(main())
