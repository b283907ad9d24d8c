"""Takes the pictures of README.md and docs: pictures.py FOLDER [rehearsal | pages]

The rehearsal is what `rehearse` prints. The pages show the demo at work: two simulation servers and one that is down, with
clients who have come and gone while the charts filled.
"""

import base64
import html
import json
import pathlib
import subprocess
import sys
import urllib.request

from playwright.sync_api import expect

from browser import Browser
from demo import Demo
from fleet import BIN, SOON, until

# How many seconds the charts show.
HISTORY = 600
WIDTH = 1200
REHEARSAL = [
    "--world", "https://github.com/webots-fleet/demo/blob/main/worlds/playground.wbt",
    "--clients", "30", "--over", "5s", "--stay", "20s", "--patience", "12s"]
TERMINAL = """
    <!doctype html><meta charset="utf-8">
    <style>body { margin: 0; background: #16202a } pre { margin: 24px; color: #e8eef2; font: 15px/1.4 monospace }</style>
    <pre>%s</pre>"""


def start(browser, demo, world, width=360, height=300):
    """A page of the viewer on which a world runs. Small ones cost little to draw."""
    page = browser.page(width=width, height=height)
    page.tab.goto(f"http://{demo.session}/viewer")
    expect(page.tab.locator("#light.on")).to_be_visible()
    page.tab.get_by_role("button", name=world).click()
    page.tab.get_by_role("button", name="Connect", exact=True).click()
    page.tab.get_by_role("button", name="Play", exact=True).click()
    return page


def samples(demo):
    """How many seconds the charts have."""
    with urllib.request.urlopen(f"http://{demo.simulation}/history", timeout=SOON) as answer:
        return len(json.loads(answer.read()))


def wait(demo, count):
    """Waits until the charts have so many samples."""
    for more in range(samples(demo), count + 1, 5):
        until(f"{more} seconds have passed", lambda: samples(demo) >= more)


def shoot(page, folder, name, hosts):
    page.tab.evaluate("scrollTo(0, 0)")
    width, height = page.tab.evaluate("[innerWidth, document.documentElement.scrollHeight]")
    chromium = page.context.new_cdp_session(page.tab)
    # Playwright itself knows no WebP, which takes half the room of PNG.
    taken = chromium.send("Page.captureScreenshot", {
        "format": "webp", "quality": 90, "captureBeyondViewport": True,
        "clip": {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}})
    (folder / f"{name}.webp").write_bytes(base64.b64decode(taken["data"]))
    if page.complaints or page.hosts() != hosts:
        raise AssertionError(f"{name}: {page.complaints} {page.hosts()}")


def rehearsal(browser, demo, folder):
    """What `rehearse` prints in a terminal, once it has ended."""
    command = ["rehearse", f"http://{demo.session}", *REHEARSAL]
    done = subprocess.run([BIN / command[0], *command[1:]], stdout=subprocess.PIPE, timeout=10 * SOON, text=True, check=True)
    page = browser.page(width=900, height=100)
    shown = " ".join(command).replace(" --world", " \\\n    --world").replace(" --clients", " \\\n    --clients")
    page.tab.set_content(TERMINAL % html.escape(f"$ {shown}\n{done.stdout}"))
    shoot(page, folder, "rehearsal", set())
    page.close()


def pages(browser, demo, folder):
    """The monitors and the viewer, once the charts are full."""
    demo.add("third", "The machine in the attic")
    fleet = browser.page(width=WIDTH, height=860)
    fleet.tab.goto(f"http://{demo.session}/monitor")
    expect(fleet.tab.locator("#servers .state.up")).to_have_count(3)
    wait(demo, HISTORY // 20)
    clients = [start(browser, demo, "Playground")]
    for at, world in enumerate(["Carousel", "Playground", "Carousel", "Playground", "Carousel"], start=2):
        wait(demo, at * HISTORY // 10)
        clients.append(start(browser, demo, world))
    wait(demo, 7 * HISTORY // 10)
    clients.pop(0).close()
    clients[0].tab.get_by_role("button", name="Pause", exact=True).click()
    demo.server_sh("stop", "third")
    wait(demo, 9 * HISTORY // 10)
    clients.pop(1).close()
    viewer = start(browser, demo, "Playground", width=WIDTH, height=860)
    wait(demo, HISTORY)
    shoot(viewer, folder, "viewer", {"localhost"})
    machine = browser.page(width=WIDTH, height=860)
    machine.tab.goto(f"http://{demo.simulation}/monitor")
    expect(machine.tab.locator("#simulations td[data-label=CPU]").first).to_contain_text("%")
    shoot(machine, folder, "simulation-monitor", {"localhost"})
    expect(fleet.tab.locator("#servers .state.down")).to_have_count(1)
    shoot(fleet, folder, "session-monitor", {"localhost"})
    for one in [viewer, *clients]:
        one.close()


def main(folder, wanted):
    expect.set_options(timeout=1000 * SOON)
    takes = {"rehearsal": rehearsal, "pages": pages}
    with Demo() as demo, Browser() as browser:
        demo.add("second", "The machine in the cellar")
        for take in [takes[name] for name in wanted or takes]:
            take(browser, demo, folder)


main(pathlib.Path(sys.argv[1]).resolve(), sys.argv[2:])
