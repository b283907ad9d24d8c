"""Webots' own viewer and a project with an export of Webots, in a folder that WEBOTS_REAL_PARTS names:

    resources/web/wwi/   the viewer, as Webots' sources have it: WebotsView.js, wrenjs.js, wrenjs.wasm, wrenjs.data ...
    project/             worlds/NAME.wbt, preview/scene.x3d or scene.w3d, preview/animation.json

The viewer may be of R2023b or later; it knows solids as `<Solid>`, which exports of before R2023b have as
`<Transform type='solid'>`. What scenes load from other sites is replaced: textures by one of a single colour,
so that no test needs the internet.
"""

import json
import os
import pathlib
import re
import shutil
import struct
import zlib

from fleet import SOON, Fleet
from fleet import until as soon
from machine import Machine

PARTS = pathlib.Path(os.environ.get("WEBOTS_REAL_PARTS", "/nonexistent"))
# In seconds: without a GPU the engine is slow.
PATIENCE = 5 * SOON
MISSING = "WEBOTS_REAL_PARTS names no folder with Webots' viewer and an export, see tests/browser/real.py"


def until(what, condition):
    """Waits with this patience."""
    return soon(what, condition, PATIENCE)


def release():
    """The release of the viewer, which its component names in the addresses of its files."""
    component = PARTS / "resources/web/wwi/WebotsView.js"
    return re.search("/wwi/(R[0-9]+[ab])/", component.read_text())[1] if component.exists() else None


RELEASE = release()
# Where Webots' viewer loads its own files from; the page that draws an export from its files is there too.
SITE = f"https://cyberbotics.com/wwi/{RELEASE}/"
FILES = f'data-scene="{SITE}export/scene" data-animation="{SITE}export/animation.json" data-autoplay="false"'
# How it tells an abnormal end of a stream.
CRASH = "Streaming server error"
TYPES = {".js": "text/javascript", ".css": "text/css", ".wasm": "application/wasm", ".svg": "image/svg+xml"}
FREE = {"Access-Control-Allow-Origin": "*"}
# The scene of a viewer; its name has changed with R2025a.
SCENE = "(({ w3dScene, x3dScene }) => w3dScene ?? x3dScene)(document.querySelector('webots-view')._view)"
# Draws the scene and returns the picture in the same turn: later the browser has discarded it.
DRAW = f"""() => {{
    const scene = {SCENE};
    scene.renderer.render();
    return scene.domElement.querySelector('canvas').toDataURL();
}}"""
# The share of pixels that two pictures have in common, and of those of the first that differ from its first pixel.
COMPARE = """async pictures => {
    const [one, other] = await Promise.all(pictures.map(async picture => {
        const bitmap = await createImageBitmap(await (await fetch(picture)).blob());
        const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
        const context = canvas.getContext('2d');
        context.drawImage(bitmap, 0, 0);
        return context.getImageData(0, 0, bitmap.width, bitmap.height);
    }));
    if (one.width !== other.width || one.height !== other.height)
        throw new Error(`${one.width}x${one.height} and ${other.width}x${other.height}`);
    let [equal, content] = [0, 0];
    for (let at = 0; at < one.data.length; at += 4) {
        const differs = (data, from) => [0, 1, 2].some(part => Math.abs(one.data[at + part] - data[from + part]) > 4);
        equal += !differs(other.data, at);
        content += differs(one.data, 0);
    }
    return { equal: 4 * equal / one.data.length, content: 4 * content / one.data.length };
}"""


def page(attributes):
    """A page with the viewer alone, which has these attributes."""
    return f"""<!doctype html><meta charset="utf-8">
<style>html, body, webots-view {{ margin: 0; width: 100%; height: 100%; display: block; overflow: hidden; }}</style>
<script type="module" src="{SITE}WebotsView.js"></script>
<webots-view {attributes}></webots-view>"""


def exported():
    """The scene of the export."""
    folder = PARTS / "project/preview"
    return next((path for path in (folder / "scene.w3d", folder / "scene.x3d") if path.exists()), None)


def is_there():
    return RELEASE is not None and exported() is not None


def world():
    """The name of the project's world."""
    return min((PARTS / "project/worlds").glob("*.wbt")).stem


def frames():
    """The frames of the animation."""
    return json.loads((PARTS / "project/preview/animation.json").read_text())["frames"]


def colour_png(size, colour):
    """A square picture of this colour."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", size, size, 8, 2, 0, 0, 0)
    rows = (b"\0" + bytes(colour) * size) * size
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")


def colour_hdr(size, colour):
    """The same with a high dynamic range, as backgrounds have."""
    head = f"#?RADIANCE\n# one colour\nFORMAT=32-bit_rle_rgbe\n\n-Y {size} +X {size}\n".encode()
    return head + bytes([*colour, 128]) * size * size


PNG, HDR = colour_png(64, (150, 170, 190)), colour_hdr(64, (150, 170, 190))


def answer(route):
    """Answers a request to another site."""
    url = route.request.url.split("?")[0]
    name = url.removeprefix(SITE)
    file = PARTS / "resources/web/wwi" / name
    if url == f"{SITE}files.html":
        route.fulfill(body=page(FILES), content_type="text/html")
    elif name == "export/scene":
        route.fulfill(path=exported(), headers=FREE, content_type="text/plain")
    elif name == "export/animation.json":
        route.fulfill(path=PARTS / "project/preview/animation.json", headers=FREE, content_type="application/json")
    elif name != url and file.is_file():
        route.fulfill(path=file, headers={**FREE, "Content-Type": TYPES.get(file.suffix, "application/octet-stream")})
    elif url.endswith(".hdr"):
        route.fulfill(body=HDR, headers=FREE, content_type="application/octet-stream")
    elif url.endswith((".png", ".jpg", ".jpeg")):
        route.fulfill(body=PNG, headers=FREE, content_type="image/png")
    else:
        route.abort()


class Real:
    """A fleet whose world has an export of Webots and whose Webots is installed as far as the viewer needs it."""

    def _project(self, work):
        shutil.copytree(PARTS / "project", work, ignore=shutil.ignore_patterns(".git"))
        # A Webots streams only to a viewer of its own kind, and a project's world may be for an older Webots.
        for file in (pathlib.Path(work) / "worlds").glob("*.wbt"):
            file.write_text(re.sub("^#VRML_SIM R[0-9]+[ab]", f"#VRML_SIM {RELEASE}", file.read_text()))


class RealFleet(Real, Fleet):
    pass


class RealMachine(Real, Machine):
    pass
