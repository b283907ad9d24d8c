"""Simulations that end: the page was offline for too long, they stayed paused, or the tab was closed."""

import pathlib
import re
import unittest

from case import Running, kept, seconds
from fleet import WORLD, until
from playwright.sync_api import expect


class OfflineForLong(Running):
    may_complain = True
    # Far shorter than the defaults of 60, 20 and 60 s.
    simulation = {"timing": {"absence": 10, "ping": 1, "silence": 3}}

    def test_who_was_offline_for_too_long_leaves_nothing_and_is_told_why(self):
        page, server = self.running()
        pid = self.pid(server)
        page.context.set_offline(True)
        until("the simulation is gone", lambda: not server.status()["simulations"])
        until("nothing is left of it", lambda: not pathlib.Path(f"/proc/{pid}").exists())
        expect(page.tab.locator("#notice-advice")).to_have_text("Your simulation may have ended.")
        self.assertEqual(kept(page)["absence"], 10)
        page.context.set_offline(False)
        expect(page.tab.locator("#problem-text")).to_have_text(
            re.compile(r"^There was no connection for \d+ seconds: the simulation has ended.$")
        )
        expect(page.tab.get_by_role("button", name="Connect", exact=True)).to_be_enabled()
        self.assertIsNone(kept(page))


class Idle(Running):
    # Twelve seconds; during the last six the page warns.
    simulation = {"idleTimeout": 0.2}

    def test_who_stays_paused_is_told_and_keeps_the_simulation_by_a_button(self):
        page, server = self.start_world()
        told = page.tab.locator("#idle")
        expect(told).to_contain_text(re.compile("The simulation is paused, and ends in [1-6] seconds?."))
        expect(page.tab.locator("#spoken")).to_contain_text("The simulation is paused")
        page.tab.get_by_role("button", name="Keep it").click()
        expect(told).to_be_hidden()
        expect(told).to_be_visible()
        page.tab.get_by_role("button", name="Play", exact=True).click()
        expect(told).to_be_hidden()
        until("it has run for longer than it may be paused", lambda: seconds(page) > 13)
        expect(told).to_be_hidden()
        self.assertEqual(len(server.status()["simulations"]), 1)
        page.tab.get_by_role("button", name="Pause", exact=True).click()
        expect(page.tab.locator("#problem-text")).to_contain_text("The simulation was paused for 0.2 min")
        expect(page.tab.locator("#problem-advice")).to_contain_text("Connect again")
        expect(told).to_be_hidden()
        self.assertEqual(server.status()["simulations"], [])

    def test_one_that_a_controller_has_started_is_kept_by_the_page(self):
        page = self.open(self.fleet.session.url("viewer"))
        streams = []

        def stream(socket):
            streams.append(socket)
            socket.connect_to_server()

        page.tab.route_web_socket(re.compile(r"^ws://127\.0\.0\.1:\d+/$"), stream)
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        # As Webots sends to all pages, without printing it.
        streams[-1].send("real-time")
        expect(page.tab.locator("#mode")).to_have_text("real time")
        told = page.tab.locator("#idle-text")
        for _ in range(2):
            until("it is told", lambda: told.inner_text() != "")
            told.evaluate("element => element.textContent = ''")
        expect(page.tab.locator("#idle")).to_be_hidden()
        expect(page.tab.locator("#problem")).to_be_hidden()
        page.tab.get_by_role("button", name="Disconnect").click()


class Killed(Running):
    # The page's connections break.
    may_complain = True

    def test_whose_server_was_killed_is_told_that_it_was_lost_and_what_helps(self):
        page, server = self.running()
        pid = self.pid(server)
        server.kill()
        expect(page.tab.locator("#problem-text")).to_have_text(
            "The server was lost. Your simulation is over; start it again."
        )
        expect(page.tab.locator("#problem-advice")).to_contain_text("Connect again")
        until("nothing is left of it", lambda: not pathlib.Path(f"/proc/{pid}").exists())
        # The other server runs the next one.
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()


class Gone(Running):
    simulation = {"timing": {"absence": 2}}

    def test_of_a_tab_that_was_closed_nothing_is_left(self):
        page, server = self.running()
        page.tab.close()
        until("the simulation is gone", lambda: not server.status()["simulations"])

    def test_who_comes_back_too_late_is_told(self):
        page, server = self.running()
        page.tab.goto("about:blank")
        until("the simulation is gone", lambda: not server.status()["simulations"])
        page.tab.go_back()
        expect(page.tab.locator("#problem-text")).to_contain_text("This simulation has ended")
        expect(page.tab.get_by_role("button", name="Connect", exact=True)).to_be_enabled()
        self.assertEqual(page.tab.get_by_label("URL of a world").input_value(), WORLD.format("playground"))


if __name__ == "__main__":
    unittest.main()
