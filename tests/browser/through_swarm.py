"""A visit through the door of a fleet on Docker Swarm: through_swarm.py http://HOST/viewer [--kill SERVICE]

Waits until the door answers, and prints when the scene moves, in milliseconds since boot. With --kill it then kills the
container of the chosen simulation server, which belongs to SERVICE, and prints when it did so, when the page reported
it, and when the scene moves again after a click. The certificate is not checked.
"""

import json
import subprocess
import sys
import time
import urllib.parse

from browser import Browser, Page
from fleet import SOON, until
from playwright.sync_api import Error, expect


def say(what):
    print(what, round(1000 * time.clock_gettime(time.CLOCK_BOOTTIME)), flush=True)


def opened(tab, url):
    """Whether the page loads: the door or the servers behind it may not run yet."""
    try:
        return tab.goto(url).ok
    except Error:
        return False


def connect_until_it_moves(tab):
    connect = tab.get_by_role("button", name="Connect", exact=True)
    connect.click()
    expect(tab.locator("[data-step=simulation].done")).to_be_visible()
    still = tab.locator("#view").screenshot()
    tab.get_by_role("button", name="Play", exact=True).click()
    until("simulated time passes", lambda: tab.locator("#clock").inner_text() not in ("", "0:00.000"))
    until("the scene moves", lambda: tab.locator("#view").screenshot() != still)


def container_of(tab, service):
    """The container of the simulation server that was chosen: ws://HOST/ADDRESS/PORT."""
    address = urllib.parse.urlsplit(tab.locator("[data-step=server] small").inner_text()).path.split("/")[1]
    docker = lambda *arguments: (
        subprocess.run(["docker", *arguments], check=True, capture_output=True, text=True).stdout
    )
    names = docker("ps", "--quiet", "--filter", f"label=com.docker.swarm.service.name={service}").split()
    networks = {one["Id"]: one["NetworkSettings"]["Networks"].values() for one in json.loads(docker("inspect", *names))}
    return next(name for name, ours in networks.items() if any(one["IPAddress"] == address for one in ours))


def visit(browser, url, service):
    context = browser.chromium.new_context(ignore_https_errors=True)
    context.set_default_timeout(1000 * SOON)
    page = Page(context)
    tab = page.tab
    until("the page is there", lambda: opened(tab, url))
    expect(tab.locator("#availability")).to_contain_text("Available")
    tab.get_by_role("button", name="Playground").click()
    connect_until_it_moves(tab)
    say("moves")
    if service:
        container = container_of(tab, service)
        say("kill")
        subprocess.run(["docker", "kill", container], check=True, stdout=subprocess.DEVNULL)
        expect(tab.locator("#problem-text")).to_contain_text("Your simulation is over")
        say("told")
        connect_until_it_moves(tab)
        say("again")
    # The page has sent all its requests to the door, with the scheme with which it was loaded.
    origin = urllib.parse.urlsplit(url)
    ways = {
        (one.scheme, one.netloc)
        for one in map(urllib.parse.urlsplit, page.asked)
        if one.scheme not in ("data", "blob", "about")
    }
    assert ways == {(origin.scheme, origin.netloc), (origin.scheme.replace("http", "ws"), origin.netloc)}, ways
    # If the page were merely closed, its simulation would wait for it.
    tab.get_by_role("button", name="Disconnect").click()
    expect(tab.get_by_role("button", name="Connect", exact=True)).to_be_enabled()
    page.close()


expect.set_options(timeout=1000 * SOON)
with Browser() as visitor:
    visit(visitor, sys.argv[1], sys.argv[3] if "--kill" in sys.argv else None)
