"""Webots' own viewer draws an export of Webots that the demo simulator streams, as it draws it from its files, and
takes each end of a simulation as what it is."""

import os
import re
import signal
import unittest

import real
from case import Administered, BrowserTest
from fleet import WORLD
from playwright.sync_api import expect
from real import until
from site_of_others import Site

# Pictures of one scene differ a little: ambient occlusion is noise that is averaged over several frames.
SAME = 0.985


class RealViewer:
    """The tests; a class runs them with a way of the stream."""

    # The viewer loads files of its own, and scenes their textures, from other sites: `real` answers.
    elsewhere = frozenset({"cyberbotics.com", "raw.githubusercontent.com"})

    keys = {"webotsHome": str(real.PARTS)}

    @classmethod
    def make_fleet(cls):
        return real.RealFleet(simulation=cls.keys)

    def viewer(self):
        return self.fleet.session.url("viewer")

    def keeps_to_the_rules(self, page):
        self.assertLessEqual(page.hosts(), {self.host, *self.elsewhere}, "who was asked")

    def offline(self, url):
        """A page whose requests to other sites are answered here."""
        page = self.open("about:blank", width=640, height=480, ignore_https_errors=True)
        page.context.route(re.compile("^https://(?!localhost)"), real.answer)
        page.context.set_default_timeout(1000 * real.PATIENCE)
        page.tab.goto(url)
        return page

    def streamed(self):
        """The fleet's page with the viewer in it, and the viewer's frame."""
        page = self.offline(f"{self.viewer()}?url={WORLD.format(real.world())}&play=1")
        expect(page.tab.locator("#availability.on")).to_be_visible()
        page.tab.get_by_label("Shown by").select_option("webots")
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        return page, self.shown(page)

    def shown(self, page):
        """The frame of the viewer, once that shows the scene."""
        frame = page.tab.locator("#stage iframe").element_handle().content_frame()
        frame.wait_for_selector("#play-button", state="attached")
        return frame

    def from_files(self, frame):
        """A page of the same size that draws the export from its files."""
        page = self.offline("about:blank")
        width, height = frame.evaluate("[innerWidth, innerHeight]")
        page.tab.set_viewport_size({"width": width, "height": height})
        page.tab.goto(f"{real.SITE}files.html")
        page.tab.wait_for_selector("#play-button", state="attached")
        return page.tab

    def shared(self, frame, files, time):
        """The share of pixels that the viewer and the files have in common, with the files at this time."""
        frames = real.frames()
        round_of = frames[-1]["time"] + frames[1]["time"] - frames[0]["time"] or 1
        last = max(number for number, one in enumerate(frames) if one["time"] <= time % max(round_of, 1))
        files.evaluate("step => document.querySelector('webots-view')._view.animation.updateAnimationState(step)", last)
        return files.evaluate(real.COMPARE, [frame.evaluate(real.DRAW), files.evaluate(real.DRAW)])

    def press(self, frame, name):
        frame.locator(f"#{name}-button").dispatch_event("click")

    def time(self, frame):
        return frame.evaluate("document.querySelector('webots-view')._view.time")

    def test_it_draws_what_the_files_have_and_obeys_its_buttons(self):
        page, frame = self.streamed()
        until("the robot drives by itself, as the page's URL says", lambda: self.time(frame) > 500)
        self.press(frame, "play")
        paused = until("time stands still", lambda: self.stands_still(frame))
        files = self.from_files(frame)
        there = self.shared(frame, files, paused)
        self.assertGreater(there["content"], 0.2, "it is no picture")
        self.assertGreater(there["equal"], SAME, f"at {paused}")
        elsewhere = self.shared(frame, files, 0)
        self.assertLess(elsewhere["equal"], there["equal"] - 0.005, "the robot can't be seen")

        self.press(frame, "step")
        until("it has made a step", lambda: paused < self.time(frame) < paused + 100)
        self.press(frame, "reset")
        until("it is reset", lambda: self.time(frame) == 0)
        until("it draws the beginning", lambda: self.shared(frame, files, 0)["equal"] > SAME)

        page.tab.set_viewport_size({"width": 560, "height": 460})
        until("it has the new size", lambda: frame.evaluate("canvas.width === view3d.clientWidth && innerWidth < 560"))
        small = self.from_files(frame)
        until("it draws the same in the new size", lambda: self.shared(frame, small, 0)["equal"] > SAME)

        self.opens_a_robot_window(frame)
        pid = self.pid()
        self.comes_back_after_a_lost_connection(page)
        self.assertEqual(self.pid(), pid)

        os.kill(pid, signal.SIGKILL)
        expect(page.tab.locator("#problem-text")).not_to_be_empty()
        expect(page.tab.get_by_role("button", name="Connect", exact=True)).to_be_enabled()

    def opens_a_robot_window(self, frame):
        """The project has a page for its robot, which the viewer shows in a frame."""
        (folder,) = (real.PARTS / "project/plugins/robot_windows").iterdir()
        window = frame.locator(".floating-robot-window iframe").first.element_handle().content_frame()
        until("the robot's window is loaded", lambda: f"/robot_windows/{folder.name}/" in window.url)
        window.wait_for_load_state("domcontentloaded")
        self.assertGreater(window.locator("body *").count(), 0, window.url)

    def pid(self):
        """Of the simulation."""
        servers = (self.fleet.simulation, self.fleet.other)
        (simulation,) = [one for server in servers for one in server.status()["simulations"]]
        return simulation["pid"]

    def comes_back_after_a_lost_connection(self, page):
        # The browser reports what it can't reach.
        self.may_complain = True
        page.context.set_offline(True)
        expect(page.tab.locator("#notice-text")).to_contain_text("No connection for")
        page.context.set_offline(False)
        expect(page.tab.locator("#notice")).to_be_hidden()
        frame = self.shown(page)
        before = self.time(frame)
        self.press(frame, "play")
        until("the robot drives again", lambda: self.time(frame) > before + 500)

    def stands_still(self, frame):
        """The time once two looks at it, with a drawing between them, are the same."""
        before = self.time(frame)
        frame.evaluate(real.DRAW)
        frame.evaluate("new Promise(resolve => setTimeout(resolve, 500))")
        return before if self.time(frame) == before else None


@unittest.skipUnless(real.is_there(), real.MISSING)
class Direct(RealViewer, BrowserTest):
    keys = {**RealViewer.keys, "streaming": "direct"}


@unittest.skipUnless(real.is_there(), real.MISSING)
class Relayed(RealViewer, BrowserTest):
    keys = {**RealViewer.keys, "streaming": "relay"}


class BehindWebServer(RealViewer):
    """Webots' own port has a path of the web server."""

    host = "localhost"
    program = None

    @classmethod
    def make_fleet(cls):
        return real.RealMachine(cls.program, places=2, simulation={**cls.keys, "streaming": "direct"})

    def viewer(self):
        return self.fleet.url("viewer")


@unittest.skipUnless(real.is_there(), real.MISSING)
class BehindApache(BehindWebServer, BrowserTest):
    program = "apache2"


@unittest.skipUnless(real.is_there(), real.MISSING)
class BehindNginx(BehindWebServer, BrowserTest):
    program = "nginx"


class Ending(Administered):
    """Simulations end while the viewer alone shows them, without a page of the fleet, as it was made for.

    The streams are relayed: only then the server chooses the code with which they close.
    """

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.site = cls.enterClassContext(Site(cls.fleet))

    @classmethod
    def make_fleet(cls):
        keys = {**RealViewer.keys, "streaming": "relay", "adminPassword": cls.password}
        return real.RealFleet(simulation={**keys, **cls.simulation})

    def keeps_to_the_rules(self, _):
        """The page is not ours."""

    def walk(self):
        """A page whose robot drives, its simulation server, and the simulation."""
        page = self.open("about:blank", width=320, height=240)
        page.context.set_default_timeout(1000 * real.PATIENCE)
        page.context.route(re.compile("^https://"), real.answer)
        page.dialogs = []
        page.tab.on("dialog", lambda dialog: (page.dialogs.append(dialog.message), dialog.dismiss()))
        address = self.fleet.session.url(f"session?url={WORLD.format(real.world())}")
        page.tab.goto(self.site.put("viewer", real.page(f'data-server="{address}"')))
        page.tab.wait_for_selector("#play-button", state="attached")
        page.tab.evaluate(
            "document.querySelector('webots-view')._view.stream.socket.addEventListener('close', ({ code }) => {"
            "window.code = code; })"
        )
        self.press(page)
        page.tab.wait_for_function("document.querySelector('webots-view')._view.time > 500")
        servers = [server for server in (self.fleet.simulation, self.fleet.other) if server.process.poll() is None]
        ((server, simulation),) = [(server, one) for server in servers for one in self.simulations(server)]
        return page, server, simulation

    def press(self, page):
        page.tab.locator("#play-button").dispatch_event("click")

    def code(self, page):
        """The code with which the page's stream closes; its dialogs until then are in `page.dialogs`."""
        return page.tab.wait_for_function("window.code", timeout=400_000).json_value()


@unittest.skipUnless(real.is_there(), real.MISSING)
class Ends(Ending):
    # Half a minute.
    simulation = {"idleTimeout": 0.5}

    def test_an_administrator_stops_it(self):
        page, server, simulation = self.walk()
        self.act(server, f"simulations/{simulation['id']}/stop", {"reason": "The lesson is over"})
        self.assertEqual((self.code(page), page.dialogs), (1000, []))

    def test_it_is_paused_for_too_long(self):
        page, _, _ = self.walk()
        self.press(page)
        self.assertEqual((self.code(page), page.dialogs), (1000, []))

    def test_its_server_is_drained_and_stops(self):
        page, server, simulation = self.walk()
        self.act(server, "drain")
        until("the server is full", lambda: server.get("load") == "100")
        self.assertEqual([one["id"] for one in self.simulations(server)], [simulation["id"]])
        server.process.terminate()
        self.assertEqual((self.code(page), page.dialogs), (1000, []))

    def test_it_crashes(self):
        page, _, simulation = self.walk()
        os.kill(simulation["pid"], signal.SIGKILL)
        self.assertNotEqual(self.code(page), 1000)
        (question,) = page.dialogs
        self.assertIn(real.CRASH, question)


@unittest.skipUnless(real.is_there(), real.MISSING)
class TimeLimit(Ending):
    # The shortest that there is.
    simulation = {"timeout": 360}

    def test_its_time_is_over(self):
        page, _, _ = self.walk()
        self.assertEqual(self.code(page), 1000)
        # The viewer's own announcement, five minutes before.
        (announcement,) = page.dialogs
        self.assertIn("The simulation will be automatically closed in 5 minutes", announcement)


if __name__ == "__main__":
    unittest.main()
