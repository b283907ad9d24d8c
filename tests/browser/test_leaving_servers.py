"""The viewer requests another simulation server if the one it was sent to drains, is gone, or can't start anything."""

import signal
import unittest

from case import BrowserTest
from fleet import until
from playwright.sync_api import expect


class LeavingServers(BrowserTest):
    # The session server polls rarely, so that it keeps choosing a server that has left.
    session = {"loadRefresh": 600}

    def knows_only(self, server):
        self.fleet.session.reload(simulationServers=[server.address])
        known = lambda: [(one["address"], one["state"]) for one in self.fleet.session.status()["servers"]]
        until("the session server knows that one alone", lambda: known() == [(server.address, "up")])

    def connect(self, page):
        expect(page.tab.locator("#availability.on")).to_contain_text("Available")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()

    def is_led_to_the_other(self, page):
        expect(page.tab.locator("[data-step=session]")).to_contain_text("another one is asked for")
        self.knows_only(self.fleet.other)
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        self.assertEqual(page.tab.locator("[data-step=server] small").inner_text(), f"ws://{self.fleet.other.address}")
        expect(page.tab.locator("#problem")).to_be_hidden()


class Draining(LeavingServers):
    def test_a_client_of_a_draining_server_is_led_to_another(self):
        self.knows_only(self.fleet.simulation)
        first, _ = self.start_world()
        self.fleet.simulation.process.send_signal(signal.SIGUSR1)
        until("it drains", lambda: self.fleet.simulation.status()["draining"])
        second = self.open(self.fleet.session.url("viewer"))
        self.connect(second)
        self.is_led_to_the_other(second)
        self.assertEqual(len(self.fleet.simulation.status()["simulations"]), 1, "the first goes on")
        expect(first.tab.locator("#problem")).to_be_hidden()


class Killed(LeavingServers):
    def test_the_client_of_a_killed_server_is_told_and_led_to_another(self):
        self.knows_only(self.fleet.simulation)
        page = self.browser.page()
        self.addCleanup(page.close)
        page.tab.goto(self.fleet.session.url("viewer"))
        self.connect(page)
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        self.fleet.simulation.kill()
        expect(page.tab.locator("#notice-text")).to_contain_text("No connection for")
        expect(page.tab.locator("#problem-text")).to_contain_text("The server was lost. Your simulation is over")
        self.connect(page)
        self.is_led_to_the_other(page)


class Failing(LeavingServers):
    session = {}

    @classmethod
    def make_fleet(cls):
        fleet = cls.fleet_of_script('[ -e "$folder/repaired" ] || exit 3\nexec "$simulator" "$@"')
        cls.repaired = cls.webots.with_name("repaired")
        return fleet

    def failures(self):
        servers = (self.fleet.simulation, self.fleet.other)
        return sum(server.log.read_text().count("a start has failed for a reason of this server") for server in servers)

    def test_another_one_is_asked_for_three_times_at_most(self):
        page = self.open(self.fleet.session.url("viewer"))
        self.connect(page)
        expect(page.tab.locator("[data-step=session]")).to_contain_text("another one is asked for")
        expect(page.tab.locator("#problem-text")).to_contain_text("Webots ended with exit code 3")
        self.assertEqual(self.failures(), 4)
        # The next attempt counts from zero, and finds the repaired server.
        self.connect(page)
        expect(page.tab.locator("[data-step=session]")).to_contain_text("another one is asked for")
        self.repaired.touch()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        expect(page.tab.locator("#problem")).to_be_hidden()


if __name__ == "__main__":
    unittest.main()
