"""Streams relayed by the simulation server, and an administrator who watches."""

import re
import unittest

from case import BrowserTest, picture
from fleet import until
from playwright.sync_api import expect


class Relayed(BrowserTest):
    simulation = {"streaming": "relay", "adminPassword": "secret"}

    def test_a_simulation_is_steered_through_the_server_and_watched(self):
        student, server = self.start_world()
        streams = [url for url in student.asked if "/stream/" in url]
        self.assertTrue(
            all(url.startswith(f"ws://{server.address}/stream/") for url in streams) and streams, student.asked
        )
        student.tab.get_by_role("button", name="Play", exact=True).click()
        expect(student.tab.locator("#mode")).to_have_text("real time")
        expect(student.tab.locator("#watched")).to_be_hidden()

        monitor = self.open("about:blank")
        monitor.sign_in(server.url("").rstrip("/"), "secret")
        row = monitor.tab.locator("#simulations tr")
        expect(row.locator("[data-label=Port]")).to_have_text(re.compile(r"^\d+$"))
        link = row.get_by_role("link", name="Watch")
        address = link.get_attribute("href")
        self.assertRegex(address, r"^watch\?id=[0-9T-]+$")
        teacher = self.open("about:blank")
        teacher.sign_in(server.url("").rstrip("/"), "secret")
        sent = self.sent_over_streams(teacher)
        teacher.tab.goto(server.url(address))
        expect(teacher.tab.locator("#state")).to_have_text("Watching")
        expect(student.tab.locator("#watched")).to_have_text("The administrator is watching.")
        expect(teacher.tab.get_by_role("button", name="Home view")).to_be_visible()
        for name in ["Play", "Pause", "Step", "Reset"]:
            expect(teacher.tab.get_by_role("button", name=name, exact=True)).to_be_hidden()
        clock = teacher.tab.locator("#clock")
        before = clock.inner_text()
        until("the teacher sees time pass", lambda: clock.inner_text() != before)
        shown = picture(teacher)
        until("the teacher sees it move", lambda: picture(teacher) != shown)
        expect(student.tab.locator("#mode")).to_have_text("real time")
        # The world is one of R2025a. A request for another kind would be an error in the student's console.
        self.assertEqual(sent, ["w3d;broadcast"])
        expect(student.tab.locator("#stage details")).to_be_hidden()
        teacher.close()
        expect(student.tab.locator("#watched")).to_be_hidden()

        again = self.open("about:blank")
        again.sign_in(server.url("").rstrip("/"), "secret")
        again.tab.goto(server.url(address))
        expect(again.tab.locator("#state")).to_have_text("Watching")
        student.tab.get_by_role("button", name="Disconnect").click()
        expect(again.tab.locator("#state")).to_have_text(re.compile("It is over"))


if __name__ == "__main__":
    unittest.main()
