"""The page of the class at the session server: everybody of all servers, behind one sign-in."""

import contextlib
import functools
import os
import pathlib
import sys
import time
import unittest

from case import BrowserTest
from fleet import WORLD, until
from playwright.sync_api import expect
from students import START, start_all

PASSWORD = "open sesame"
KEY = "a key of a whole fleet"
# Run in a page: opens this many connections that hear announcements, as viewers do, and keeps what each heard last.
LISTEN = """
    async (count) => {
      window.told = Array(count).fill('');
      const open = (_, index) => new Promise((resolve, reject) => {
        const socket = new WebSocket('session?announcements=1');
        socket.onopen = resolve;
        socket.onerror = reject;
        socket.onmessage = ({ data }) => (told[index] = data);
      });
      await Promise.all(told.map(open));
    }"""

# Whether all have heard this last.
ALL_TOLD = "(text) => told.every((one) => one === text)"


@contextlib.contextmanager
def stopwatch(took, what):
    """Records in `took` for how many seconds this has taken."""
    begin = time.monotonic()
    yield
    took[what] = time.monotonic() - begin


class OneClass(BrowserTest):
    session = {"adminPassword": PASSWORD, "fleetKey": KEY}
    # Also on a busy machine.
    simulation = {"fleetKey": KEY, "readyLoad": 1000}

    def start(self, names, world="carousel"):
        """A page whose students have simulations."""
        page = self.open(self.fleet.session.url("viewer"))
        start_all(page, names, lambda name: None, WORLD.format(world))
        return page

    def teacher(self, **options):
        page = self.open("about:blank", **options)
        page.sign_in(self.fleet.session.url("").rstrip("/"), PASSWORD)
        expect(page.tab.locator("h1")).to_have_text("Class")
        expect(page.tab.locator("#live")).to_have_text("Live")
        return page

    def test_a_teacher_asks_for_simulations_that_are_ready_for_a_lesson(self):
        page = self.teacher()
        page.tab.get_by_label("World", exact=True).fill(WORLD.format("carousel"))
        page.tab.get_by_label("How many").fill("1")
        now = page.tab.evaluate("Date.now()")
        later = page.tab.evaluate(
            "(time) => new Date(time - 60000 * new Date(time).getTimezoneOffset()).toISOString().slice(0, 16)",
            now + 3_600_000,
        )
        page.tab.get_by_label("until").fill(later)
        page.tab.get_by_role("button", name="Keep ready").click()
        kept = page.tab.locator("#ready-worlds li")
        expect(kept).to_contain_text("carousel.wbt 1 of 1 ready now; 1 until")
        (asked,) = self.fleet.session.status()["requested"]
        self.assertLess(abs(page.tab.evaluate("(time) => Date.parse(time)", asked["until"]) - now - 3_600_000), 60_000)
        self.assertEqual(page.faults(), [])
        kept.get_by_role("button", name="End carousel.wbt").click()
        expect(kept).to_have_count(0)
        # A world that is none is named, and nothing is kept.
        page.tab.get_by_label("World", exact=True).fill("https://example.org/nothing")
        page.tab.get_by_role("button", name="Keep ready").click()
        expect(page.tab.locator("#ready-problem")).to_contain_text("Wrong Webots simulation URL")
        page.complaints.clear()

    def test_a_teacher_has_all_servers_on_one_page(self):
        students = self.start(["anna", "ben", "chloe"])
        others = self.start(["dora"], "playground")
        page = self.teacher()
        rows = page.tab.locator("#class tr")
        expect(rows).to_have_count(4)
        servers = {row.inner_text() for row in page.tab.locator("#class td[data-label=Server]").all()}
        self.assertEqual(servers, {self.fleet.simulation.address, self.fleet.other.address})
        self.assertEqual(page.faults(), [])
        # Only names, worlds and servers are searched, by the beginnings of their words.
        field = page.tab.get_by_label("Name, world or server")
        for text, count in [("dora", 1), ("2026", 0), ("carousel", 3), ("anna carousel", 1), ("nna", 0)]:
            field.fill(text)
            expect(page.tab.locator("#filtered")).to_have_text(f"{count} of 4")
        field.fill("anna")
        anna = page.tab.locator("#class tr:visible")
        expect(anna).to_have_count(1)
        # Watching needs no other sign-in, and the page leads back.
        with page.context.expect_page() as opened:
            anna.get_by_role("link", name="Watch").click()
        watched = opened.value
        expect(watched.locator("#state")).to_have_text("Watching")
        back = watched.get_by_role("link", name="Class").get_attribute("href")
        self.assertEqual(back, self.fleet.session.url("class"))
        watched.close()
        # One is stopped, with a reason.
        anna.get_by_role("button", name="Stop").click()
        dialog = page.tab.get_by_role("dialog")
        expect(dialog).to_contain_text("carousel.wbt of Anna at desk 1")
        self.assertEqual(page.faults(), [])
        dialog.get_by_label("Reason").fill("Come here")
        dialog.get_by_role("button", name="Stop it").click()
        expect(dialog).to_be_hidden()
        expect(page.tab.locator("#filtered")).to_have_text("0 of 3")
        # All of one world.
        field.fill("carousel")
        page.tab.get_by_role("button", name="Stop all 2").click()
        expect(dialog.locator("h2")).to_have_text("Stop these 2 simulations?")
        dialog.get_by_role("button", name="Stop 2").click()
        expect(dialog).to_be_hidden()
        expect(page.tab.locator("#filtered")).to_have_text("0 of 1")
        # An announcement.
        page.tab.get_by_label("Text for all open viewers").fill("<i>Five</i> minutes")
        page.tab.get_by_role("button", name="Announce").click()
        expect(students.tab.locator("#announcement")).to_contain_text("Five")
        expect(page.tab.locator("#announcement")).to_have_text("<i>Five</i> minutes")
        others.close()
        expect(page.tab.locator("#class tr")).to_have_count(0)
        page.tab.get_by_role("link", name=self.fleet.other.address).click()
        expect(page.tab.get_by_role("link", name="Class")).to_be_visible()
        expect(page.tab.locator("#simulations")).to_be_attached()
        page.tab.goto(self.fleet.session.url("class"))
        page.tab.get_by_role("button", name="Sign out").click()
        page.tab.goto(self.fleet.session.url("class"))
        expect(page.tab.get_by_label("Password")).to_be_visible()

    def test_names_are_text_and_two_with_one_name_are_told_apart(self):
        students = self.open(self.fleet.session.url("viewer"))
        evil = "<img src=x onerror=\"document.title='evil'\">"
        for name in ["Nora 14", "Nora 1", "Chloe", "Chloe", evil]:
            students.tab.evaluate(START, [WORLD.format("carousel"), name])
        students.tab.evaluate("Promise.all(simulations)")
        page = self.teacher(width=390, height=844)
        expect(page.tab.locator("#class tr")).to_have_count(5)
        self.assertEqual(page.tab.locator("#class img").count(), 0)
        self.assertNotEqual(page.tab.title(), "evil")
        expect(page.tab.locator("#class")).to_contain_text(evil)
        self.assertEqual((page.faults(), page.overflow()), ([], 0))
        field = page.tab.get_by_label("Name, world or server")
        field.fill("Nora 14")
        expect(page.tab.locator("#filtered")).to_have_text("1 of 5")
        field.fill("chloe")
        twins = page.tab.locator("#class tr:visible .twin")
        expect(twins).to_have_count(2)
        self.assertEqual(len(set(twins.all_inner_texts())), 2)
        students.close()
        field.fill("")
        expect(page.tab.locator("#class tr")).to_have_count(0)

    def halls(self, names):
        """Four servers in place of the two, where these students have two worlds; and the students' page."""
        more = {"maxConnections": 50, "isolation": "none", **self.simulation}
        servers = [self.fleet._simulation(f"hall{number}", more) for number in range(4)]
        before = self.fleet.session.config["simulationServers"]
        self.addCleanup(self.fleet.session.reload, simulationServers=before)
        self.fleet.session.reload(simulationServers=[server.address for server in servers])
        until(
            "four servers are up",
            lambda: [one["state"] for one in self.fleet.session.status()["servers"]] == ["up"] * 4,
        )
        students = self.open(self.fleet.session.url("viewer"))
        # Twenty at a time, as they come in.
        for first in range(0, len(names), 20):
            for number in range(first, first + 20):
                world = WORLD.format("playground" if number % 2 else "carousel")
                students.tab.evaluate(START, [world, names[number]])
            students.tab.evaluate("Promise.all(simulations)")
        self.assertEqual([len(server.status()["simulations"]) for server in servers], [len(names) // 4] * 4)
        return servers, students

    def test_two_hundred_on_four_servers_are_in_hand(self):
        names = [f"Student {number:03}" for number in range(200)]
        servers, students = self.halls(names)
        # Who has the page open hears announcements. A browser opens 255 WebSockets for a profile.
        listeners = self.open(self.fleet.session.url("viewer"))
        listeners.tab.evaluate(LISTEN, 200)
        page = self.teacher()
        shown = page.tab.locator("#filtered")
        expect(shown).to_have_text("200 in all")
        timed = functools.partial(stopwatch, took := {})
        field = page.tab.get_by_label("Name, world or server")
        with timed("found"):
            field.fill("student 114")
            expect(shown).to_have_text("1 of 200")
        row = page.tab.locator("#class tr:visible")
        (server,) = [one for one in servers if one.address in row.inner_text()]
        with timed("watched"), page.context.expect_page() as opened:
            row.get_by_role("link", name="Watch").click()
            expect(opened.value.locator("#state")).to_have_text("Watching")
        opened.value.close()
        row.get_by_role("button", name="Stop").click()
        dialog = page.tab.get_by_role("dialog")
        dialog.get_by_label("Reason").fill("Enough")
        with timed("one stopped"):
            dialog.get_by_role("button", name="Stop it").click()
            expect(shown).to_have_text("0 of 199")
        self.assertRegex(server.log.read_text(), r'administrator "teacher".*Enough')
        # All of one world.
        field.fill("playground")
        expect(shown).to_have_text("100 of 199")
        page.tab.get_by_role("button", name="Stop all 100").click()
        expect(dialog.locator("h2")).to_have_text("Stop these 100 simulations?")
        with timed("100 stopped"):
            dialog.get_by_role("button", name="Stop 100").click()
            expect(shown).to_have_text("0 of 99")
        # All are told.
        page.tab.get_by_label("Text for all open viewers").fill("Five more minutes")
        with timed("200 told"):
            page.tab.get_by_role("button", name="Announce").click()
            until("all are told", lambda: listeners.tab.evaluate(ALL_TOLD, "announcement: Five more minutes"))
        page.tab.get_by_role("button", name="End it").click()
        with timed("downloaded"), page.tab.expect_download() as download:
            page.tab.get_by_role("link", name="Download as CSV").click()
        lines = pathlib.Path(download.value.path()).read_text().splitlines()
        self.assertTrue(lines[0].endswith(",server"), lines[0])
        self.assertEqual(len(lines), 1 + 101)
        for number in (114, 1, 199):
            self.assertTrue(any(f'"{names[number]}"' in line for line in lines), number)
        # It depends on the speed of the machine.
        if "QUIET_MACHINE" in os.environ:
            print(took, file=sys.stderr)
            self.assertLess(max(took.values()), 2)
        self.assertEqual(page.faults(), [])
        students.close()
        field.fill("")
        expect(page.tab.locator("#class tr")).to_have_count(0)


if __name__ == "__main__":
    unittest.main()
