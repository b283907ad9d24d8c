"""Takes the pictures of docs/pages.md and README.md: pictures.py FOLDER

They show the demo at work: two simulation servers and one that is down, with clients who have come and gone while the
charts filled.
"""

import base64
import json
import pathlib
import sys
import urllib.request

from playwright.sync_api import expect

from browser import Browser
from demo import Demo
from fleet import SOON, until

# How many seconds the charts show.
HISTORY = 600
WIDTH = 1200


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


def shoot(page, folder, name):
    page.tab.evaluate("scrollTo(0, 0)")
    width, height = page.tab.evaluate("[innerWidth, document.documentElement.scrollHeight]")
    chromium = page.context.new_cdp_session(page.tab)
    # Playwright itself knows no WebP, which takes half the room of PNG.
    taken = chromium.send("Page.captureScreenshot", {
        "format": "webp", "quality": 90, "captureBeyondViewport": True,
        "clip": {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}})
    (folder / f"{name}.webp").write_bytes(base64.b64decode(taken["data"]))
    if page.complaints or page.hosts() != {"localhost"}:
        raise AssertionError(f"{name}: {page.complaints} {page.hosts()}")


def main(folder):
    expect.set_options(timeout=1000 * SOON)
    with Demo() as demo, Browser() as browser:
        demo.add("second", "The machine in the cellar")
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
        shoot(viewer, folder, "viewer")
        machine = browser.page(width=WIDTH, height=860)
        machine.tab.goto(f"http://{demo.simulation}/monitor")
        expect(machine.tab.locator("#simulations td[data-label=CPU]").first).to_contain_text("%")
        shoot(machine, folder, "simulation-monitor")
        expect(fleet.tab.locator("#servers .state.down")).to_have_count(1)
        shoot(fleet, folder, "session-monitor")
        for one in [viewer, *clients]:
            one.close()


main(pathlib.Path(sys.argv[1]).resolve())
