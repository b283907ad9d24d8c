"""The pages for visitors in their languages."""

import re
import unittest

from case import BrowserTest
from fleet import until
from playwright.sync_api import expect

MISSING = "https://github.com/demo/worlds/blob/main/worlds/missing.wbt"
# The headings of the viewer page, and what it says of a world that does not exist.
LANGUAGES = [
    ("en", "en", "Try a world", "missing.wbt"),
    ("de", "de", "Eine Welt ausprobieren", "Diese Welt gibt es dort nicht"),
    ("fr", "fr", "Essayer un monde", "existe pas à cet endroit"),
    ("es", "es", "Probar un mundo", "Ese mundo no existe"),
    ("zh", "zh-Hans", "试用一个世界", "那里没有这个世界"),
    ("ja", "ja", "ワールドを試す", "そのワールドがない"),
]


class Languages(BrowserTest):
    simulation = {"streaming": "relay", "adminPassword": "secret"}

    def test_each_language_is_that_of_the_page_and_tells_failures_by_their_codes(self):
        for name, tag, heading, failure in LANGUAGES:
            with self.subTest(name):
                page = self.open(self.fleet.session.url(f"viewer?lang={name}&url={MISSING}"), width=390)
                tab = page.tab
                expect(tab.locator("#availability.on")).to_be_visible()
                self.assertEqual(tab.evaluate("document.documentElement.lang"), tag)
                expect(tab.locator("h1")).to_have_text(heading)
                tab.locator("#connect").click()
                expect(tab.locator("#problem-text")).to_contain_text(failure)
                # The server's own sentence is English.
                if name == "en":
                    expect(tab.locator("#problem-sentence")).to_be_hidden()
                else:
                    expect(tab.locator("#problem-sentence")).to_contain_text("missing.wbt")
                self.assertEqual(page.faults(), [])
                self.assertLessEqual(page.overflow(), 0, "pixels too wide")
                # The address of the page stays in its language.
                self.assertIn(f"lang={name}", tab.url)

    def test_a_browser_in_german_sees_all_in_german_and_so_does_who_watches(self):
        page = self.open(self.fleet.session.url("viewer"), locale="de-CH")
        tab = page.tab
        expect(tab.locator("#availability")).to_contain_text("Verfügbar")
        tab.get_by_role("button", name="Playground").click()
        tab.get_by_role("button", name="Verbinden", exact=True).click()
        expect(tab.locator("[data-step=simulation].done")).to_be_visible()
        tab.get_by_role("button", name="Start", exact=True).click()
        expect(tab.locator("#mode")).to_have_text("Echtzeit")
        expect(tab.locator("#clock")).to_have_text(re.compile(r"^0:0[1-9],\d\d\d$"))
        expect(tab.locator("#left")).to_have_text(re.compile(r"^Sie wird in .*(Stunde|Minute).* geschlossen\.$"))
        self.assertEqual(page.faults(), [])
        servers = [one for one in (self.fleet.simulation, self.fleet.other) if one.status()["simulations"]]
        self.assertEqual(len(servers), 1)
        simulation = servers[0].status()["simulations"][0]["id"]
        watch = servers[0].url(f"watch?id={simulation}&lang=ja")
        watching = self.open("about:blank")
        watching.sign_in(servers[0].url("").rstrip("/"), "secret")
        watching.tab.goto(watch)
        expect(watching.tab.locator("#state")).to_have_text("見学中")
        expect(watching.tab.locator("h1")).to_have_text("シミュレーションの見学")
        expect(watching.tab.locator("#mode")).to_have_text("実時間")
        self.assertEqual(watching.faults(), [])
        expect(tab.locator("#watched")).to_have_text("Die Administration sieht zu.")
        tab.get_by_role("button", name="Trennen", exact=True).click()
        expect(tab.locator("#stage")).to_have_text("Du hast die Simulation verlassen; sie ist beendet.")
        until("the simulation is gone", lambda: not servers[0].status()["simulations"])


if __name__ == "__main__":
    unittest.main()
