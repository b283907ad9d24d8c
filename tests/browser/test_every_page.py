"""Requirements on every page, in both colour schemes, wide and narrow."""

import itertools
import unittest
import urllib.request

from case import BrowserTest
from fleet import SOON, free_ports, until
from playwright.sync_api import expect


class EveryPage(BrowserTest):
    def pages(self):
        session, simulation = self.fleet.session, self.fleet.simulation
        return [
            (session.url("monitor"), "#live:text('Live')"),
            (session.url("viewer"), "#availability.on"),
            (session.url("webots-viewer"), "#problem:not(:empty)"),
            (simulation.url("monitor"), "#charts figure:nth-of-type(3)"),
        ]

    def test_no_serious_fault_of_accessibility_and_no_sideways_scrolling(self):
        for url, ready in self.pages():
            page = self.open(url)
            for scheme, width in itertools.product(["light", "dark"], [1280, 360]):
                with self.subTest(url, scheme=scheme, width=width):
                    page.look(scheme, width)
                    expect(page.tab.locator(ready)).to_be_visible()
                    self.assertEqual(page.faults(), [])
                    self.assertLessEqual(page.overflow(), 0, "pixels too wide")

    def test_a_page_with_a_simulation_has_no_serious_fault_either(self):
        for scheme, width in [("light", 1280), ("dark", 360)]:
            with self.subTest(scheme=scheme, width=width):
                page, server = self.start_world(scheme=scheme, width=width)
                self.assertEqual(page.faults(), [])
                self.assertLessEqual(page.overflow(), 0)
                monitor = self.open(server.url("monitor"), scheme=scheme, width=width)
                expect(monitor.tab.locator("#simulations tr")).to_be_visible()
                self.assertEqual(monitor.faults(), [])
                self.assertLessEqual(monitor.overflow(), 0)
                page.tab.get_by_role("button", name="Disconnect").click()
                expect(monitor.tab.locator("#simulations tr")).to_have_count(0)

    def test_pages_may_run_only_what_their_server_sends(self):
        for url, _ in self.pages():
            with self.subTest(url), urllib.request.urlopen(url, timeout=SOON) as answer:
                policy, text = answer.headers["Content-Security-Policy"], answer.read().decode()
                self.assertIn("default-src 'none'", policy)
                self.assertNotIn("unsafe-inline", policy)
                self.assertRegex(policy, r"script-src 'self'( http: https: 'unsafe-eval')?;")
                self.assertEqual(answer.headers["X-Content-Type-Options"], "nosniff")
                for word in [" style=", "<style", " onclick=", "<script>"]:
                    self.assertNotIn(word, text)

    def test_everything_can_be_reached_by_tab(self):
        page = self.open(self.fleet.session.url("viewer"))
        expect(page.tab.locator("#availability.on")).to_be_visible()
        reached = []
        for _ in range(12):
            page.tab.keyboard.press("Tab")
            reached.append(page.tab.evaluate("document.activeElement.id || document.activeElement.textContent.trim()"))
        for wanted in ["Skip to the content", "Monitor", "url", "kind", "connect", "Playground", "Carousel"]:
            self.assertIn(wanted, reached)


LONG = "a-simulation-server-{}.with-a-long-name.department-of-robotics.faculty-of-engineering.university.invalid:2000"


class Crowded(BrowserTest):
    strangers = [LONG.format(number) for number in range(40)]

    def test_many_servers_with_long_names_and_long_reasons_leave_the_page_in_order(self):
        page = self.open(self.fleet.session.url("monitor"))
        expect(page.tab.locator("#servers .state.down")).to_have_count(40)
        for scheme, width in [("light", 1280), ("dark", 1160), ("light", 1000), ("dark", 360)]:
            with self.subTest(scheme=scheme, width=width):
                page.look(scheme, width)
                self.assertEqual(page.faults(), [])
                self.assertLessEqual(page.overflow(), 0, "pixels too wide")
                since = page.tab.locator("#servers tr").last.locator("td").last
                box = since.bounding_box()
                self.assertLessEqual(box["x"] + box["width"], width, "the last column is out of sight")
                changes = page.tab.get_by_role("list", name="Last changes")
                changes.evaluate("list => { list.scrollTop = 0; }")
                changes.focus()
                page.tab.keyboard.press("End")
                until("the list is scrolled", lambda: changes.evaluate("list => list.scrollTop") > 0)

    def test_a_fleet_of_no_servers_says_so_until_there_is_one(self):
        # Other load on this machine must not make the server full.
        empty = self.fleet.start(
            "session-server", "empty", {"port": free_ports(1), "simulationServers": [], "loadThreshold": 1000}
        )
        page = self.open(empty.url("monitor"))
        words = page.tab.get_by_text("None is known")
        expect(page.tab.locator("#live")).to_have_text("Live")
        expect(words).to_be_visible()
        self.assertEqual(page.faults(), [])
        empty.reload(simulationServers=[self.fleet.simulation.address])
        expect(page.tab.locator("#servers .state")).to_have_text("up")
        expect(words).to_be_hidden()


if __name__ == "__main__":
    unittest.main()
