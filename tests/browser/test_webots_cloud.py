"""The pages of webots.cloud in front of a fleet, set up as docs/webots-cloud.md says, with Webots' own viewer."""

import os
import re
import signal
import ssl
import subprocess
import unittest
import urllib.error
import urllib.request

import real
import webots_site
from case import Administered
from door import OneDoor
from fleet import WORLD
from playwright.sync_api import expect
from real import until


class Behind(real.Real, OneDoor):
    """A fleet behind one https door, and the site in front of it."""

    def __init__(self):
        super().__init__(places=1, simulation={"adminPassword": Administered.password}, signs_in=False)
        try:
            self.site = webots_site.Site(self.url(""), self.web.authority)
        except BaseException:
            self.close()
            raise
        self.exits.callback(self.site.close)

    def logs(self):
        return super().logs() + self.site.logs()


class Cloud(Administered):
    # The browser knows the site's name.
    switches = (f"--host-resolver-rules=MAP {webots_site.NAME} 127.0.0.1",)

    @classmethod
    def make_fleet(cls):
        return Behind()

    def keeps_to_the_rules(self, _):
        """These are the site's pages, not ours."""

    def visit(self, path):
        page = self.open("about:blank", width=640, height=480, ignore_https_errors=True)
        page.context.set_default_timeout(1000 * real.PATIENCE)
        page.context.route(re.compile(rf"^https://(?!localhost|{re.escape(webots_site.NAME)})"), real.answer)
        page.dialogs = []
        page.tab.on("dialog", lambda dialog: (page.dialogs.append(dialog.message), dialog.dismiss()))
        page.tab.goto(self.fleet.site.url(path))
        return page

    def run_world(self, world):
        url = WORLD.format(world)
        return self.visit(f"run?version={real.RELEASE}&type=demo&url={url}")

    def time(self, page):
        return page.tab.evaluate("document.querySelector('webots-view')?._view?.time ?? -1")

    def runs(self, page):
        page.tab.wait_for_selector("#play-button", state="attached")
        page.tab.locator("#play-button").dispatch_event("click")
        until("the robot drives", lambda: self.time(page) > 500)
        self.assertEqual(page.dialogs, [])

    def said(self, page):
        """The dialogs of a page until now, which come while it is asked for something."""
        page.tab.title()
        return page.dialogs

    def is_told(self, page, text):
        until(f"a dialog says {text}", lambda: any(text in said for said in self.said(page)))
        self.assertEqual(len(page.dialogs), 1, page.dialogs)

    def streams(self, page):
        """Whether the page's viewer has an open stream."""
        return page.tab.evaluate("document.querySelector('webots-view')?._view?.stream?.socket?.readyState === 1")

    def servers(self):
        return [self.fleet.simulation, self.fleet.other]

    def answer(self):
        """The answer of session.php."""
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        url = f"https://127.0.0.1/ajax/server/session.php?url={WORLD.format(real.world())}"
        try:
            with urllib.request.urlopen(url, context=context) as answer:
                return answer.read().decode()
        except urllib.error.HTTPError as refusal:
            return refusal.read().decode()

    def wait_for_places(self):
        until("nothing runs", lambda: not any(server.status()["simulations"] for server in self.servers()))
        # A question to /session would count as a visitor who comes.
        until("a server is offered", lambda: self.fleet.session.status()["available"])


@unittest.skipUnless(real.is_there(), real.MISSING)
@unittest.skipIf(webots_site.missing(), webots_site.missing())
class Visitors(Cloud):
    def test_two_run_a_world_and_a_third_is_told_that_all_is_full(self):
        self.wait_for_places()
        pages = []
        for _ in range(2):
            pages.append(self.run_world(real.world()))
            self.runs(pages[-1])
            # Without a GPU, a page that draws leaves no time to the others, nor to the questions of this test.
            pages[-1].tab.locator("#play-button").dispatch_event("click")
        one, other = (self.simulations(server) for server in self.servers())
        self.assertEqual((len(one), len(other)), (1, 1), "each has a server of its own")
        self.is_told(self.run_world(real.world()), "Session server error: ")

        # An intended end is no error to the viewer, a crash is one.
        self.act(self.fleet.simulation, f"simulations/{one[0]['id']}/stop", {"reason": "The lesson is over"})
        stopped = until("a stream is closed", lambda: next((page for page in pages if not self.streams(page)), None))
        until("it has ended", lambda: not self.fleet.simulation.status()["simulations"])
        pages.remove(stopped)
        os.kill(other[0]["pid"], signal.SIGKILL)
        until("the crash is told", lambda: any(real.CRASH in said for said in self.said(pages[0])))
        self.assertFalse(any(real.CRASH in said for said in self.said(stopped)), stopped.dialogs)

    def test_the_page_of_a_competition_lets_its_visitors_try(self):
        self.wait_for_places()
        # The site tries a competition on its branch of this name.
        repository = self.fleet.forge / "demo/worlds"
        subprocess.run(["git", "-C", repository, "branch", "--force", "competition", "main"], check=True)
        page = self.visit(f"run?version={real.RELEASE}&type=competition&url={WORLD.format(real.world())}")
        page.tab.locator("#try-competition").click()
        self.runs(page)
        (running,) = [one for server in self.servers() for one in self.simulations(server)]
        self.assertIn("/blob/competition/worlds/", running["world"])

    def test_one_is_told_that_a_world_is_missing(self):
        self.wait_for_places()
        page = self.run_world("nothing")
        expect(page.tab.locator("#progress-bar-info")).to_have_text("Error: worlds/nothing.wbt in main does not exist")


@unittest.skipUnless(real.is_there(), real.MISSING)
@unittest.skipIf(webots_site.missing(), webots_site.missing())
class Operators(Cloud):
    def test_the_list_loses_a_server_that_is_drained_and_the_next_visitor_is_told(self):
        url = self.fleet.machine(self.fleet.other)
        self.fleet.site.query(
            f"INSERT INTO server(id, url, share, `load`) VALUES(7, '{url}', 50, 77); "
            "INSERT INTO server_branch VALUES(7, 'main')"
        )
        page = self.visit("server")
        row = page.tab.locator("tr", has_text=url.removeprefix("https://"))
        row.wait_for()
        sync = page.tab.locator("#sync-server-7")
        sync.dispatch_event("click")
        until(
            "its load is stored", lambda: self.fleet.site.query("SELECT `load` FROM server").strip() not in ("77", "")
        )
        for server in self.servers():
            self.act(server, "drain")
            until("it has ended", lambda server=server: server.process.poll() is not None)
        sync.dispatch_event("click")
        row.wait_for(state="detached")
        self.assertEqual(self.fleet.site.query("SELECT COUNT(*) FROM server").strip(), "0")
        until("no server is offered", lambda: self.answer().startswith("Error:"))
        self.is_told(self.run_world(real.world()), "Session server error: ")


if __name__ == "__main__":
    unittest.main()
