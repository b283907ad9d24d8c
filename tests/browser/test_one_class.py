"""The page of the class at the session server: everybody of all servers, behind one sign-in."""

import pathlib
import unittest

from case import BrowserTest
from fleet import WORLD
from playwright.sync_api import expect
from roster import RosterServer
from students import START, start_all

PASSWORD = "open sesame"
KEY = "a key of a whole fleet"


class OneClass(BrowserTest):
    session = {"adminPassword": PASSWORD, "fleetKey": KEY}
    simulation = {"fleetKey": KEY}

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
        expect(page.tab.locator("#filtered")).to_have_text("0 of 3", timeout=2000)
        # All of one world.
        field.fill("carousel")
        page.tab.get_by_role("button", name="Stop all 2").click()
        expect(dialog.locator("h2")).to_have_text("Stop these 2 simulations?")
        dialog.get_by_role("button", name="Stop 2").click()
        expect(dialog).to_be_hidden()
        expect(page.tab.locator("#filtered")).to_have_text("0 of 1", timeout=2000)
        # An announcement.
        page.tab.get_by_label("Text for all open viewers").fill("<i>Five</i> minutes")
        page.tab.get_by_role("button", name="Announce").click()
        expect(students.tab.locator("#announcement")).to_contain_text("Five", timeout=2000)
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

    def test_two_hundred_on_four_servers_are_in_hand(self):
        worlds = [WORLD.format(name) for name in ("arm", "maze")]
        of = lambda server: [(f"Student {server}{number:02}", worlds[number % 2]) for number in range(98)]
        before = list(self.fleet.session.config["simulationServers"])
        with RosterServer(1, of(1)) as third, RosterServer(2, of(2)) as fourth:
            self.addCleanup(self.fleet.session.reload, simulationServers=before)
            self.fleet.session.reload(simulationServers=[*before, third.address, fourth.address])
            students = self.start(["anna", "ben", "chloe", "dora"])
            page = self.teacher()
            shown = page.tab.locator("#filtered")
            expect(shown).to_have_text("200 in all")
            # The page is told once, and then what changes.
            self.assertLess(len(page.tab.content()), 1_000_000)
            field = page.tab.get_by_label("Name, world or server")
            field.fill("student 214")
            expect(shown).to_have_text("1 of 200")
            row = page.tab.locator("#class tr:visible")
            expect(row).to_contain_text(fourth.address)
            row.get_by_role("button", name="Stop").click()
            dialog = page.tab.get_by_role("dialog")
            dialog.get_by_label("Reason").fill("Enough")
            dialog.get_by_role("button", name="Stop it").click()
            expect(shown).to_have_text("0 of 199")
            ((reason, by),) = fourth.reasons.values()
            self.assertEqual(reason, "Enough")
            self.assertIn('administrator "teacher"', by)
            # All of one world.
            field.fill("maze")
            expect(shown).to_have_text("98 of 199")
            page.tab.get_by_role("button", name="Stop all 98").click()
            expect(dialog.locator("h2")).to_have_text("Stop these 98 simulations?")
            dialog.get_by_role("button", name="Stop 98").click()
            expect(shown).to_have_text("0 of 101")
            # A real one is watched, and the records are downloaded.
            field.fill("anna")
            with page.context.expect_page() as opened:
                row.get_by_role("link", name="Watch").click()
            expect(opened.value.locator("#state")).to_have_text("Watching")
            opened.value.close()
            students.close()
            field.fill("carousel")
            expect(shown).to_have_text("0 of 97")
            with page.tab.expect_download() as download:
                page.tab.get_by_role("link", name="Download as CSV").click()
            lines = pathlib.Path(download.value.path()).read_text().splitlines()
            self.assertTrue(lines[0].endswith(",server"), lines[0])
            for name in ("Anna", "Ben", "Chloe", "Dora"):
                self.assertTrue(any(f'"{name} at desk' in line for line in lines), name)
            self.assertEqual(page.faults(), [])
        expect(page.tab.locator("#class tr")).to_have_count(0)


if __name__ == "__main__":
    unittest.main()
