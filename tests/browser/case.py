"""The base of all browser tests: one fleet per class, one browser per file; logs are printed if a test fails."""

import base64
import json
import pathlib
import shutil
import sys
import tempfile
import unittest
import urllib.request

from browser import Browser
from fleet import BIN, SOON, Fleet, until
from playwright.sync_api import expect

expect.set_options(timeout=1000 * SOON)


# Where the viewer page keeps its simulation.
KEPT = "webots-simulation /viewer simulation"


def kept(page):
    """The simulation that the tab keeps."""
    return page.tab.evaluate(f"JSON.parse(sessionStorage.getItem('{KEPT}'))?.simulation")


def picture(page):
    """A screenshot of the scene."""
    return page.tab.locator("#view").screenshot()


class BrowserTest(unittest.TestCase):
    """A class of tests with its own fleet."""

    session = None
    simulation = None
    strangers = ()
    # The host to which pages may send requests, and others.
    host = "127.0.0.1"
    elsewhere = frozenset()
    # Whether console errors are allowed: offline, the browser reports unreachable URLs.
    may_complain = False
    # Further switches of the browser, the same for all classes of a file.
    switches = ()
    browser = None

    @classmethod
    def setUpClass(cls):
        cls.fleet = cls.enterClassContext(cls.make_fleet())
        # One browser suffices because each page has its own profile.
        if BrowserTest.browser is None:
            BrowserTest.browser = unittest.enterModuleContext(Browser(cls.switches))
            unittest.addModuleCleanup(setattr, BrowserTest, "browser", None)

    @classmethod
    def make_fleet(cls):
        return Fleet(cls.session, cls.simulation, cls.strangers)

    @classmethod
    def fleet_of_script(cls, script):
        """A fleet whose Webots, `cls.webots`, is a shell script, which has its `$folder` and the demo `$simulator`."""
        folder = pathlib.Path(tempfile.mkdtemp(prefix="fleet-webots-"))
        cls.addClassCleanup(shutil.rmtree, folder)
        cls.webots = folder / "webots"
        cls.webots.write_text(f'#!/bin/sh\nfolder="{folder}" simulator="{BIN}/demo-simulator"\n{script}\n')
        cls.webots.chmod(0o755)
        return Fleet(simulation={"webots": str(cls.webots), "isolation": "none"})

    def run(self, result=None):
        before = len(result.failures) + len(result.errors)
        super().run(result)
        if len(result.failures) + len(result.errors) > before:
            print(self.fleet.logs(), file=sys.stderr)
        return result

    def open(self, url, **options):
        """Opens a page in its own tab; after the test the rules of all pages are checked."""
        page = self.browser.page(**options)
        self.addCleanup(page.close)
        self.addCleanup(self.keeps_to_the_rules, page)
        page.tab.goto(url)
        return page

    def keeps_to_the_rules(self, page):
        if not self.may_complain:
            self.assertEqual(page.complaints, [], "the console")
        self.assertLessEqual(page.hosts(), {self.host, *self.elsewhere}, "who was asked")

    def sent_over_streams(self, page):
        """What the page sends to simulators from now on."""
        sent = []

        def record(socket):
            if "/client" not in socket.url and "/session" not in socket.url:
                # Playwright takes no methods of builtin types.
                socket.on("framesent", lambda text: sent.extend([text]))

        page.tab.on("websocket", record)
        return sent

    def start_world(self, name="Playground", **options):
        """The viewer page with a simulation that is ready, and its simulation server."""
        page = self.open(self.fleet.session.url("viewer"), **options)
        expect(page.tab.locator("#availability")).to_contain_text("Available")
        page.tab.get_by_role("button", name=name).click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        chosen = page.tab.locator("[data-step=server] small").inner_text()
        servers = [one for one in (self.fleet.simulation, self.fleet.other) if chosen == f"ws://{one.address}"]
        self.assertEqual(len(servers), 1, chosen)
        return page, servers[0]


def seconds(page):
    """The simulated time that the page shows, in seconds."""
    minutes, rest = page.tab.locator("#clock").inner_text().split(":")
    return 60 * int(minutes) + float(rest)


class Administered(BrowserTest):
    """Tests with an administrator, whose password the servers have as `adminPassword`."""

    password = "a secret"

    def ask(self, server, path, **options):
        """The answer to a request of the administrator."""
        credentials = base64.b64encode(f"admin:{self.password}".encode()).decode()
        headers = {"Authorization": f"Basic {credentials}", "Content-Type": "application/json"}
        with urllib.request.urlopen(urllib.request.Request(server.url(path), headers=headers, **options)) as answer:
            return answer.read().decode()

    def act(self, server, path, body=None):
        self.ask(server, path, data=b"" if body is None else json.dumps(body).encode(), method="POST")

    def simulations(self, server):
        return json.loads(self.ask(server, "status"))["simulations"]


class Running(BrowserTest):
    """Tests of running simulations."""

    def running(self, **options):
        """A page whose simulation runs in real time."""
        page, server = self.start_world(**options)
        page.tab.get_by_role("button", name="Play", exact=True).click()
        expect(page.tab.locator("#mode")).to_have_text("real time")
        until("time passes", lambda: seconds(page) > 0.2)
        return page, server

    def pid(self, server):
        simulations = server.status()["simulations"]
        self.assertEqual(len(simulations), 1, simulations)
        return simulations[0]["pid"]

    def goes_on(self, page, server, pid, before):
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        expect(page.tab.locator("#mode")).to_have_text("real time")
        until("the clock goes on", lambda: seconds(page) > before)
        self.assertEqual(self.pid(server), pid)
        expect(page.tab.locator("#problem")).to_be_hidden()
        expect(page.tab.locator("#notice")).to_be_hidden()

    def leaves_nothing(self, page, server):
        page.tab.get_by_role("button", name="Disconnect").click()
        until("the simulation is gone", lambda: not server.status()["simulations"])
