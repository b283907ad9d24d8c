"""Runs worlds in a Webots through a fleet: walk.py PROGRAM [WORLD]...; an empty PROGRAM is that of WEBOTS_HOME."""

import base64
import json
import os
import pathlib
import platform
import re
import shutil
import socket
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
SPAN = 5.0
COLUMNS = (
    "isolation",
    "stream",
    "world",
    "ready s",
    "moving s",
    "real-time factor",
    "reset",
    "memory MB",
    "watched",
    "resumed s",
    "end s",
    "stopped s",
    "result",
)
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


def memory(pid):
    """What a process and its descendants occupy, in MB; shared pages count in each."""
    total = 0
    for status in pathlib.Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":\t", 1) for line in status.read_text().splitlines() if ":\t" in line)
        except OSError:
            continue
        if pid in ancestors(int(status.parent.name)):
            total += int(fields.get("VmRSS", "0").split()[0])
    return total // 1024


def ancestors(pid):
    """A process and its ancestors."""
    while pid > 1:
        yield pid
        try:
            pid = int(pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            return


def runs(ready, row, begin):
    """Lets the simulation run and resets it."""
    with connect(f"{ready.url}/", max_size=None) as stream:
        stream.send(ready.kind)
        until_text(stream, "scene load completed")
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


def has_ended(server, simulation, begin):
    """The seconds until nothing of the simulation is left."""
    until("the simulation has ended", lambda: not simulations(server))
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
        row["memory MB"] = memory(simulation["pid"])
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


def stopped(fleet, row):
    """An administrator ends the simulation: the client is told why; with a relay, so is its stream."""
    server = fleet.simulation
    with connect(f"ws://{server.address}/client", max_size=None) as client:
        client.send(json.dumps({"start": {"url": fleet.url, "resumable": True}}))
        ready = Ready(client)
        (simulation,) = simulations(server)
        with connect(f"{ready.url}/", max_size=None) as stream:
            stream.send(ready.kind)
            until_text(stream, "scene load completed")
            begin = time.monotonic()
            as_administrator(server, f"simulations/{simulation['id']}/stop", {"reason": REASON})
            first(client, SOON, "the reason", lambda text: '"stopped-by-administrator"' in text or None)
            try:
                first(stream, SOON, "the end of the stream", lambda _: None)
            except ConnectionClosed as closed:
                code = closed.rcvd.code if closed.rcvd else 1006
            if row["stream"] == "relay" and code != 1000:
                raise Failed(f"the stream has ended with {code}") from None
    row["stopped s"] = has_ended(server, simulation, begin)


def tried(isolation, streaming, world, program):
    """A row of the table."""
    row = {"isolation": isolation, "stream": streaming, "world": world.stem, "result": "ok"}
    keys = {"isolation": isolation, "streaming": streaming, "adminPassword": PASSWORD}
    if program:
        keys["webots"] = program
    else:
        home = os.environ["WEBOTS_HOME"]
        keys |= {"webotsHome": home, "webots": f"{home}/webots"}
    try:
        with OneWorld(world, keys) as fleet:
            student(fleet, row)
            stopped(fleet, row)
    except (Failed, AssertionError, OSError, ConnectionClosed) as error:
        row["result"] = str(error).split("\n")[0][:120]
    return row


def levels():
    yield "none"
    if shutil.which("bwrap"):
        yield "sandbox"
    else:
        print("sandbox: not here, there is no bwrap", file=sys.stderr)


def main():
    program, *worlds = sys.argv[1:]
    worlds = [pathlib.Path(world).resolve() for world in worlds] or sorted((HERE / "project/worlds").glob("*.wbt"))
    rows = [
        tried(isolation, streaming, world, program)
        for isolation in levels()
        for streaming in ("direct", "relay")
        for world in worlds
    ]
    print(f"\n{program or os.environ['WEBOTS_HOME']}, {platform.platform()}, {os.cpu_count()} cores\n")
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for row in rows:
        print(f"| {' | '.join(str(row.get(column, '-')) for column in COLUMNS)} |")
    return any(row["result"] != "ok" for row in rows)


if __name__ == "__main__":
    sys.exit(main())
