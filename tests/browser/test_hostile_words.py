"""What a simulator prints is shown as its own words and decides nothing, whatever server's sentence it resembles."""

import unittest

from case import BrowserTest
from fleet import until
from playwright.sync_api import expect

# Runs the demo simulator until there is a file with last words, which it prints.
WEBOTS = """
"$simulator" "$@" &
until [ -s "$folder/words" ]; do sleep 0.1; done
kill $!
wait
cat "$folder/words"
exit 3
"""
# As a crash of Webots, but before it listens.
BROKEN = """#!/bin/sh
echo "all places on the grid are taken"
echo "no simulation server available at the moment"
exit 3
"""


class HostileWords(BrowserTest):
    @classmethod
    def make_fleet(cls):
        fleet = cls.fleet_of_script(WEBOTS)
        cls.words = cls.webots.with_name("words")
        return fleet

    def starts(self):
        """Number of simulations that were asked for."""
        return sum(one.log.read_text().count("asks for") for one in (self.fleet.simulation, self.fleet.other))

    def test_a_world_that_crashes_with_any_words_is_not_started_again(self):
        advice = set()
        for words in [
            "No such file or directory",
            "all places on the grid are taken",
            "This simulation server has no Webots that it can run",
            "error: no simulation server available at the moment",
        ]:
            with self.subTest(words):
                page, server = self.start_world()
                self.words.write_text(f"{words}\n")
                expect(page.tab.locator("#problem-text")).to_contain_text("exit code 3")
                self.words.unlink()
                expect(page.tab.locator("#problem-text")).not_to_contain_text(words)
                expect(page.tab.locator("#problem-output-text")).to_contain_text(words)
                expect(page.tab.locator("#notice")).to_be_hidden()
                expect(page.tab.get_by_role("button", name="Connect", exact=True)).to_be_enabled()
                self.assertEqual(page.faults(), [])
                advice.add(page.tab.locator("#problem-advice").inner_text())
                self.assertEqual(server.status()["simulations"], [])
        self.assertEqual(len(advice), 1, advice)

    def test_a_simulator_that_does_not_start_leads_to_another_server_whatever_it_prints(self):
        self.webots.rename(self.webots.with_suffix(".kept"))
        self.webots.write_text(BROKEN)
        self.webots.chmod(0o755)
        self.addCleanup(self.webots.with_suffix(".kept").rename, self.webots)
        before = self.starts()
        page = self.open(self.fleet.session.url("viewer"))
        expect(page.tab.locator("#availability.on")).to_be_visible()
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=session]")).to_contain_text("another one is asked for")
        expect(page.tab.locator("#problem-output-text")).to_contain_text("all places on the grid are taken")
        expect(page.tab.locator("#notice")).to_be_hidden()
        self.assertEqual(self.starts() - before, 4, "another one is asked for three times")
        until("nothing runs", lambda: not self.fleet.simulation.status()["simulations"])


if __name__ == "__main__":
    unittest.main()
