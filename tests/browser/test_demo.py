"""A visitor's way through the demo, from `./server.sh start demo` to `./server.sh stop demo`."""

import unittest

from case import BrowserTest, picture
from demo import Demo
from fleet import until
from playwright.sync_api import expect


def clock(page):
    """The simulation's time in milliseconds."""
    minutes, seconds = page.tab.locator("#clock").inner_text().split(":")
    return round(60_000 * int(minutes) + 1000 * float(seconds))


class TheDemo(BrowserTest):
    host = "localhost"

    @classmethod
    def make_fleet(cls):
        return Demo()

    def test_a_visitors_way(self):
        fleet_monitor = self.open(f"http://{self.fleet.session}/monitor")
        expect(fleet_monitor.tab.locator("#live")).to_have_text("Live")
        fleet_monitor.tab.evaluate("window.same = true")
        machine_monitor = self.open(f"http://{self.fleet.simulation}/monitor")
        rows = machine_monitor.tab.locator("#simulations tr")
        expect(machine_monitor.tab.get_by_text("No simulations.")).to_be_visible()

        page = self.open(f"http://{self.fleet.session}/viewer")
        expect(page.tab.locator("#availability.on")).to_contain_text("Available")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        expect(page.tab.locator("#steps li.done")).to_have_count(6)
        expect(rows).to_have_count(1)
        for words in ["playground.wbt", "github.com/webots-fleet/demo", "idle"]:
            expect(rows).to_contain_text(words)
        expect(fleet_monitor.tab.locator("#glance")).to_contain_text("1 of 10 places")
        self.moves_pauses_steps_and_resets(page, rows)
        for one in [fleet_monitor, machine_monitor, page]:
            self.assertEqual(one.faults(), [])

        page.tab.get_by_role("button", name="Disconnect").click()
        expect(rows).to_have_count(0)
        page.close()
        expect(fleet_monitor.tab.locator("#glance")).to_contain_text("0 of 10 places")
        self.assertTrue(fleet_monitor.tab.evaluate("window.same"), "the page was loaded again")
        # The servers stop now; console errors of these pages would not count.
        machine_monitor.close()
        fleet_monitor.close()
        self.assertNotEqual(self.fleet.leftovers(), [], "what runs is seen")
        self.fleet.server_sh("stop", "demo")
        until("nothing is left", lambda: self.fleet.leftovers() == [])

    def moves_pauses_steps_and_resets(self, page, rows):
        press = lambda name: page.tab.get_by_role("button", name=name, exact=True).click()
        self.assertEqual(clock(page), 0)
        first = picture(page)
        press("Play")
        until("half a second has passed", lambda: clock(page) > 500)
        expect(rows).to_contain_text("running")
        press("Pause")
        expect(page.tab.locator("#mode")).to_have_text("paused")
        paused = clock(page)
        self.assertNotEqual(picture(page), first, "nothing has moved")
        expect(rows).to_contain_text("idle")
        self.assertEqual(clock(page), paused, "time stands still")
        press("Step")
        until("one step is made", lambda: clock(page) == paused + 16)
        press("Reset")
        until("time is zero", lambda: clock(page) == 0)
        until("all is where it was", lambda: picture(page) == first)


if __name__ == "__main__":
    unittest.main()
