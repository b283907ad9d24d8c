"""Takes the pictures of docs/pages.md: pictures.py FOLDER"""

import json
import pathlib
import sys

from playwright.sync_api import expect

from browser import Browser
from fleet import SOON, Fleet, until

# How many seconds the charts show.
HISTORY = 120


def start(browser, fleet, world):
    """A page of the viewer on which a world runs."""
    page = browser.page(width=1180, height=860)
    page.tab.goto(fleet.session.url("viewer"))
    expect(page.tab.locator("#light.on")).to_be_visible()
    page.tab.get_by_role("button", name=world).click()
    page.tab.get_by_role("button", name="Connect", exact=True).click()
    page.tab.get_by_role("button", name="Play", exact=True).click()
    return page


def seconds(server):
    return len(json.loads(server.get("history")))


def wait(fleet, count):
    """Waits until the charts have so many samples."""
    for more in range(seconds(fleet.simulation), count + 1):
        until(f"{more} seconds have passed", lambda: seconds(fleet.simulation) >= more)


def shoot(page, folder, name, whole=True):
    page.tab.screenshot(path=folder / f"{name}.png", full_page=whole, animations="disabled")
    if page.complaints or page.hosts() != {"127.0.0.1"}:
        raise AssertionError(f"{name}: {page.complaints} {page.hosts()}")


def main(folder):
    expect.set_options(timeout=1000 * SOON)
    with Fleet() as fleet, Browser() as browser:
        viewer = start(browser, fleet, "Playground")
        wait(fleet, HISTORY // 3)
        shoot(viewer, folder, "viewer")
        viewer.tab.get_by_role("button", name="Pause", exact=True).click()
        others = [start(browser, fleet, "Carousel") for _ in range(2)]
        wait(fleet, HISTORY)
        page = browser.page(width=1180, height=860)
        page.tab.goto(fleet.simulation.url("monitor"))
        expect(page.tab.locator("#simulations td[data-label=CPU]").first).to_contain_text("%")
        shoot(page, folder, "simulation-monitor")
        page.tab.goto(fleet.session.url("monitor"))
        fleet.other.kill()
        expect(page.tab.locator(".state.down").first).to_be_visible()
        shoot(page, folder, "session-monitor")
        for one in [viewer, *others]:
            one.close()


main(pathlib.Path(sys.argv[1]).resolve())
