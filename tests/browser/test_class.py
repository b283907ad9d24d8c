"""A class of thirty on two machines behind one door: names, watching, stopping, announcing, and a prank that fails."""

import re
import unittest

from browser import Page
from case import BrowserTest
from door import COOKIE, OneDoor
from fleet import SOON, WORLD, until
from playwright.sync_api import expect
from students import NAMES, label, start_all

PASSWORD = "open sesame"
# The students whose page shows the simulation.
TABS = NAMES[:3]
# Returns whether the WebSocket was opened; if so, sends the prank.
PRANK = """
    (url) => new Promise((resolve) => {
      const socket = new WebSocket(url);
      socket.onopen = () => { socket.send('pause'); socket.send('reset'); resolve(true); };
      socket.onerror = () => resolve(false);
    })"""
# Makes a page record the time at which an announcement appears.
NOTICE = """
    (place) => {
      new MutationObserver(() => { window.announced ||= place.textContent && Date.now(); })
        .observe(place, { childList: true, subtree: true, characterData: true, attributes: true });
    }"""


class AClass(BrowserTest):
    host = "localhost"

    @classmethod
    def make_fleet(cls):
        # A slot on each machine for half of the class, and one more.
        return OneDoor(places=16, session={"adminPassword": PASSWORD}, simulation={"adminPassword": PASSWORD})

    def visit(self, name, path, **options):
        """A page in a separate browser profile, signed in at the door under this name."""
        context = self.browser.chromium.new_context(
            ignore_https_errors=True, viewport={"width": 1000, "height": 700}, **options
        )
        context.set_default_timeout(1000 * SOON)
        context.add_cookies([{"name": COOKIE, "value": name, "url": self.fleet.url("")}])
        page = Page(context)
        self.addCleanup(page.close)
        page.tab.goto(self.fleet.url(path))
        return page

    def student(self, name):
        """The page of a student whose viewer shows a simulation."""
        page = self.visit(name, f"viewer?name={name.title()}&url={WORLD.format('playground')}")
        expect(page.tab.locator("#visitor")).to_contain_text(f"The administrator sees you as {name.title()}.")
        expect(page.tab.locator("#availability.on")).to_be_visible()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        return page

    def monitors(self):
        """The teacher's pages: the monitor of each machine, opened from the fleet's monitor."""
        fleet = self.visit("teacher", "monitor")
        fleet.sign_in(self.fleet.url("").rstrip("/"), PASSWORD)
        fleet.tab.goto(self.fleet.url("monitor"))
        expect(fleet.tab.locator("#servers .state.up, #servers .state.full")).to_have_count(2)
        machines = []
        for link in fleet.tab.locator("#servers th a").all():
            machine = Page(fleet.context)
            machine.sign_in(link.get_attribute("href").removesuffix("/monitor"), PASSWORD)
            expect(machine.tab.locator("#live")).to_have_text("Live")
            machines.append(machine)
        fleet.tab.goto(self.fleet.url("class"))
        return fleet, machines

    def test_a_teacher_has_a_class_of_thirty_in_hand(self):
        students = {name: self.student(name) for name in TABS}
        # The others run without pages of their own; all have signed in.
        others = self.visit(NAMES[3], "viewer")
        become = lambda name: others.context.add_cookies([{"name": COOKIE, "value": name, "url": self.fleet.url("")}])
        streams = start_all(others, NAMES[3:], become, WORLD.format("carousel"))
        for page in students.values():
            expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        anna = students["anna"]
        anna.tab.get_by_role("button", name="Play", exact=True).click()
        expect(anna.tab.locator("#mode")).to_have_text("real time")

        fleet, machines = self.monitors()
        self.every_student_has_a_name(machines)
        machine = self.the_teacher_finds_and_watches(anna, machines)
        self.the_prank_fails(students["ben"], anna, streams)
        self.all_are_told(fleet, [students["ben"], students["chloe"], others])
        self.one_is_stopped_with_a_reason(anna, machine)
        # The other simulations are not affected.
        for machine in machines:
            machine.tab.get_by_label("Filter").fill("")
        until(
            "the others run on",
            lambda: sum(one.tab.locator("#simulations tr").count() for one in machines) == len(NAMES) - 1,
        )
        expect(students["ben"].tab.locator("#problem")).to_be_hidden()
        for page in [fleet, *machines, *students.values()]:
            self.keeps_to_the_rules(page)

    def every_student_has_a_name(self, machines):
        """Users appear under their sign-in names, beside the unverified names that they chose."""
        read = """table => [...table.querySelectorAll('td[data-label=Who]')]
            .map((cell) => [cell.querySelector('b')?.textContent, cell.querySelector('span')?.textContent])"""
        parts = lambda: [dict(one.tab.locator("#simulations").evaluate(read)) for one in machines]
        until("all are listed", lambda: sum(map(len, parts())) == len(NAMES))
        one, other = parts()
        self.assertEqual(sorted({**one, **other}), sorted(f"{name}@school.example" for name in NAMES))
        for name in NAMES:
            called = name.title() if name in TABS else label(name)
            self.assertEqual((one | other)[f"{name}@school.example"], f"{called} unverified")
        self.assertGreater(min(len(one), len(other)), 8, "each machine has its part of the class")

    def the_teacher_finds_and_watches(self, student, machines):
        """Returns the monitor that lists the student."""
        for machine in machines:
            machine.tab.get_by_label("Filter").fill("anna@")
        found = [one for one in machines if one.tab.locator("#simulations tr:visible").count()]
        self.assertEqual(len(found), 1)
        row = found[0].tab.locator("#simulations tr:visible")
        expect(row).to_have_count(1)
        expect(row).to_contain_text("anna@school.example")
        with found[0].context.expect_page() as opened:
            row.get_by_role("link", name="Watch").click()
        watching = opened.value
        expect(watching.locator("#state")).to_have_text("Watching")
        expect(student.tab.locator("#watched")).to_have_text("The administrator is watching.")
        before = watching.locator("#clock").inner_text()
        until("the teacher sees time pass", lambda: watching.locator("#clock").inner_text() != before)
        watching.close()
        expect(student.tab.locator("#watched")).to_be_hidden()
        return found[0]

    def the_prank_fails(self, prankster, victim, streams):
        """A student of the same class can't reach the simulation of another."""
        stream = next(url for url in victim.asked if "/stream/" in url)
        base, token = re.fullmatch(r"(wss://.*)/stream/([0-9a-f]+)/", stream).groups()
        machine = base.replace("wss://", "https://")
        status = prankster.tab.evaluate("url => fetch(url).then((answer) => answer.json())", f"{machine}/status")
        self.assertGreater(len(status["simulations"]), 8)
        for one in status["simulations"]:
            self.assertIsNone(one["port"])
        for secret in (token, "anna", "Anna"):
            self.assertNotIn(secret, str(status))
        # Guessed ports and invalid tokens: simulation ids, altered tokens, a token of another machine.
        server = next(one for one in (self.fleet.simulation, self.fleet.other) if f"/{one.config['server']}/" in base)
        elsewhere = next(url for url in streams if not url.startswith(base))
        ports = [base.replace(f"/{server.port}", f"/{port}") + "/" for port in range(server.port + 1, server.port + 17)]
        tokens = [one["id"] for one in status["simulations"]] + [
            token[:-1],
            token.upper() + "0",
            "0" * len(token),
            elsewhere.rsplit("/", 1)[1],
        ]
        complaints = len(prankster.complaints)
        for url in ports + [f"{base}/stream/{one}/" for one in tokens]:
            self.assertFalse(prankster.tab.evaluate(PRANK, url), url)
        del prankster.complaints[complaints:]
        for one in status["simulations"]:
            stop = prankster.context.request.post(f"{machine}/simulations/{one['id']}/stop")
            self.assertEqual(stop.status, 401)
        expect(victim.tab.locator("#mode")).to_have_text("real time")

    def all_are_told(self, fleet, pages):
        """An announcement is on open viewers and monitors within two seconds."""
        monitor = self.visit("ivan", "monitor")
        expect(monitor.tab.locator("#live")).to_have_text("Live")
        for page in [*pages, monitor]:
            page.tab.locator("#announcement").evaluate(NOTICE)
        fleet.tab.get_by_label("Text for all open viewers").fill("Please save your work.")
        button = fleet.tab.get_by_role("button", name="Announce")
        button.evaluate("button => button.addEventListener('click', () => { window.clicked = Date.now(); })")
        button.click()
        for page in [*pages, monitor]:
            expect(page.tab.locator("#announcement")).to_contain_text("Please save your work.")
            took = page.tab.evaluate("announced") - fleet.tab.evaluate("clicked")
            self.assertLessEqual(took, 2000, page.tab.url)

    def one_is_stopped_with_a_reason(self, student, machine):
        machine.tab.locator("#simulations tr:visible").get_by_role("button", name="Stop").click()
        dialog = machine.tab.get_by_role("dialog")
        expect(dialog).to_contain_text("anna@school.example")
        dialog.get_by_label("Reason").fill("Please come to my desk")
        dialog.get_by_role("button", name="Stop it").click()
        expect(dialog).to_be_hidden()
        expect(student.tab.locator("#problem")).to_contain_text(
            "The administrator has stopped this simulation: Please come to my desk"
        )
        expect(machine.tab.locator("#ends tr").first).to_contain_text("anna@school.example")


if __name__ == "__main__":
    unittest.main()
