"""Runs worlds in a Webots through a fleet: walk.py PROGRAM [WORLD]...; an empty PROGRAM is that of WEBOTS_HOME."""

import json
import os
import pathlib
import platform
import shutil
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "browser"))

from fleet import SOON, Fleet, until  # noqa: E402
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
    "end",
    "result",
)


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


def stream_of(client):
    """The URL of the simulation's stream, and the scene to request."""
    kind = "w3d"

    def chosen(text):
        nonlocal kind
        if text.startswith(("error:", "Error:", "loading: Error:")):
            raise Failed(text.split("\n")[0])
        kind = text.removeprefix("kind: ") if text.startswith("kind: ") else kind
        return text.removeprefix("webots:") if text.startswith("webots:") else None

    return first(client, START, "webots:", chosen), kind


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


def walk(fleet, row):
    """The way of a student through the fleet; fills a row of the table."""
    server = fleet.simulation
    begin = time.monotonic()
    with connect(f"ws://{server.address}/client", max_size=None) as client:
        client.send(json.dumps({"start": {"url": fleet.url}}))
        url, kind = stream_of(client)
        row["ready s"] = f"{time.monotonic() - begin:.1f}"
        (simulation,) = server.status()["simulations"]
        with connect(f"{url}/", max_size=None) as stream:
            stream.send(kind)
            until_text(stream, "scene load completed")
            stream.send("real-time:-1")
            now = moved(stream)
            row["moving s"] = f"{time.monotonic() - begin:.1f}"
            row["real-time factor"] = f"{speed(stream, now):.2f}"
            row["memory MB"] = memory(simulation["pid"])
            stream.send("reset")
            until_text(stream, "reset finished")
            stream.send("real-time:-1")
            if moved(stream) > now + 1000 * SPAN:
                raise Failed("the time goes on after a reset")
            row["reset"] = "yes"
    left = time.monotonic()
    until("the simulation has ended", lambda: not server.status()["simulations"])
    until("its process has ended", lambda: not pathlib.Path(f"/proc/{simulation['pid']}").exists())
    row["end"] = f"{time.monotonic() - left:.1f} s"


def tried(isolation, streaming, world, program):
    """A row of the table."""
    row = {"isolation": isolation, "stream": streaming, "world": world.stem, "result": "ok"}
    keys = {"isolation": isolation, "streaming": streaming}
    if program:
        keys["webots"] = program
    else:
        home = os.environ["WEBOTS_HOME"]
        keys |= {"webotsHome": home, "webots": f"{home}/webots"}
    try:
        with OneWorld(world, keys) as fleet:
            walk(fleet, row)
    except (Failed, AssertionError, OSError) as error:
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
