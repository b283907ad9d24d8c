"""A teacher and a class: who is who, stopping a simulation, announcing. And a list of 200 on a phone."""

import json
import unittest
import urllib.parse

from case import BrowserTest
from fleet import until
from playwright.sync_api import expect

PASSWORD = "open sesame"
LABEL = "Anna <img src=x onerror=\"document.title='evil'\">"


class Administrator(BrowserTest):
    session = {"adminPassword": PASSWORD}
    simulation = {"adminPassword": PASSWORD}

    def page_with_password(self, url, **options):
        page = self.open(url, **options)
        page.sign_in(url.removesuffix("/monitor"), PASSWORD)
        return page

    def student(self, name):
        page = self.open(f"{self.fleet.session.url('viewer')}?name={name}")
        expect(page.tab.locator("#availability")).to_contain_text("Available")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        chosen = page.tab.locator("[data-step=server] small").inner_text()
        return page, self.fleet.simulation if chosen == f"ws://{self.fleet.simulation.address}" else self.fleet.other

    def test_a_teacher_finds_a_student_and_stops_the_simulation_with_a_reason(self):
        student, server = self.student(urllib.parse.quote(LABEL))
        expect(student.tab.locator("#visitor")).to_contain_text(f"The administrator sees you as {LABEL}.")
        self.assertIn("name=Anna", student.tab.url)
        # Without the password no names are shown, and nothing can be stopped.
        stranger = self.open(server.url("monitor"))
        expect(stranger.tab.locator("#simulations tr")).to_have_count(1)
        self.assertNotIn("Anna", stranger.tab.content())
        expect(stranger.tab.get_by_role("button", name="Stop")).to_have_count(0)

        teacher = self.open(server.url("monitor"))
        teacher.tab.get_by_role("link", name="Sign in").click()
        self.assertEqual(teacher.faults(), [])
        teacher.tab.get_by_label("Password").fill("a guess")
        teacher.tab.get_by_role("button", name="Sign in").click()
        expect(teacher.tab.get_by_role("alert")).to_have_text("This is not the password.")
        self.assertEqual(teacher.faults(), [])
        # The browser reports the status of the page.
        teacher.complaints.clear()
        teacher.sign_in(server.url("").rstrip("/"), PASSWORD)
        row = teacher.tab.locator("#simulations tr")
        expect(row.locator('td[data-label="Who"]')).to_contain_text(LABEL)
        expect(row.locator('td[data-label="Who"]')).to_contain_text("unverified")
        self.assertEqual(row.locator("img").count(), 0, "a name is no markup")
        self.assertNotEqual(teacher.tab.title(), "evil")
        expect(teacher.tab.locator("#live")).to_have_text("Live")
        # Live updates keep what the password shows, and the filter.
        teacher.tab.get_by_label("Filter").fill("anna play")
        teacher.tab.get_by_role("columnheader", name="Who").first.get_by_role("button").click()
        student.tab.get_by_role("button", name="Play", exact=True).click()
        expect(row.locator(".state")).to_have_text("running")
        expect(row.locator('td[data-label="Who"]')).to_contain_text(LABEL)
        self.assertEqual(teacher.faults(), [])
        row.get_by_role("button", name="Stop").click()
        dialog = teacher.tab.get_by_role("dialog")
        expect(dialog).to_contain_text(LABEL)
        self.assertEqual(teacher.faults(), [])
        # Cancels first.
        dialog.get_by_role("button", name="Cancel").click()
        expect(dialog).to_be_hidden()
        expect(row.locator(".state")).to_have_text("running")
        row.get_by_role("button", name="Stop").click()
        dialog.get_by_label("Reason").fill("Please come <b>here</b>")
        dialog.get_by_role("button", name="Stop it").click()
        expect(dialog).to_be_hidden()
        problem = student.tab.locator("#problem")
        expect(problem).to_contain_text("The administrator has stopped this simulation: Please come \u2039b\u203ahere")
        expect(problem).to_contain_text("Ask the administrator")
        expect(teacher.tab.locator("#ends tr").first).to_contain_text("administrator")
        expect(teacher.tab.locator("#ends tr").first).to_contain_text("Anna")
        expect(teacher.tab.locator("#simulations tr")).to_have_count(0)
        teacher.tab.get_by_role("button", name="Sign out").click()
        expect(teacher.tab.get_by_role("link", name="Sign in")).to_be_visible()
        expect(teacher.tab.locator("#ends tr").first).not_to_contain_text("Anna")

    def test_an_announcement_is_seen_on_open_pages_and_is_gone_when_it_is_over(self):
        viewer = self.open(self.fleet.session.url("viewer"))
        expect(viewer.tab.locator("#availability")).to_contain_text("Available")
        stranger = self.open(self.fleet.session.url("monitor"))
        expect(stranger.tab.locator("#live")).to_have_text("Live")
        teacher = self.page_with_password(self.fleet.session.url("monitor"))
        expect(teacher.tab.locator("#live")).to_have_text("Live")
        text = "Maintenance <b onclick=alert(1)>at noon</b>"
        teacher.tab.get_by_label("Text for all open viewers").fill(text)
        teacher.tab.get_by_role("button", name="Announce").click()
        # Characters of markup are replaced, so that no page can interpret the text as markup.
        expect(viewer.tab.locator("#announcement")).to_have_text(text.replace("<", "\u2039").replace(">", "\u203a"))
        expect(stranger.tab.locator("#announcement")).to_contain_text(text)
        for page in (viewer, stranger):
            self.assertEqual(page.tab.locator("#announcement b").count(), 0)
            self.assertEqual(page.faults(), [])
        late = self.open(self.fleet.session.url("viewer"))
        expect(late.tab.locator("#announcement")).to_contain_text("Maintenance")
        teacher.tab.get_by_role("button", name="End it").click()
        expect(viewer.tab.locator("#announcement")).to_be_hidden()
        expect(stranger.tab.locator("#announcement")).to_have_text("")

    def test_the_labels_of_the_charts_stay_while_the_page_lives(self):
        page = self.open(self.fleet.simulation.url("monitor"))
        expect(page.tab.locator("#charts polyline").first).not_to_have_attribute("points", "")
        page.tab.evaluate("""() => {
            window.labels = [...document.querySelectorAll('#charts .axes text, #charts .moment')];
            window.line = document.querySelector('#charts polyline').getAttribute('points');
        }""")
        self.assertGreater(page.tab.evaluate("labels.filter(one => one.textContent === 'now').length"), 3)
        until(
            "another sample has come",
            lambda: page.tab.evaluate("document.querySelector('#charts polyline').getAttribute('points') !== line"),
        )
        self.assertTrue(
            page.tab.evaluate("labels.filter(one => one.textContent === 'now').every(one => one.isConnected)")
        )

    def test_two_hundred_rows_can_be_filtered_and_sorted_on_a_phone(self):
        def row(number, state):
            name = f"student{number:03}.wbt"
            link = f'<a href="https://example.org">{name}</a><small>github.com/lab/arm</small>'
            cells = [
                ("State", state, f'<span class="state {state}">{state}</span>'),
                ("Since", number, "12:00"),
                ("Time left", 1, "1 h"),
                ("CPU", number, f"{number} %"),
                ("Memory", 1, "90 MiB"),
                ("Port", number, number),
                ("Output", "", "Last lines"),
            ]
            head = f'<th role="rowheader" scope="row" data-value="{name}">{link}</th>'
            rest = [
                f'<td role="cell" data-label="{label}" data-value="{value}">{text}</td>' for label, value, text in cells
            ]
            return {"key": f"2026-{number}", "html": "".join([head, *rest])}

        more = []

        def event():
            state = "running" if more else "idle"
            rows = [row(number, state) for number in range(200 + len(more))]
            return "retry: 500\n\ndata: " + json.dumps({"tables": {"simulations": rows}}) + "\n\n"

        page = self.browser.page(width=390, height=844)
        self.addCleanup(page.close)
        page.tab.route("**/events", lambda route: route.fulfill(content_type="text/event-stream", body=event()))
        page.tab.goto(self.fleet.simulation.url("monitor"))
        rows = page.tab.locator("#simulations tr")
        expect(rows).to_have_count(200)
        self.assertEqual(page.overflow(), 0)
        head = page.tab.get_by_role("columnheader", name="CPU")
        head.get_by_role("button").click()
        head.get_by_role("button").click()
        expect(rows.first).to_contain_text("student199")
        # The filter stays visible at the end of the list.
        rows.last.scroll_into_view_if_needed()
        field = page.tab.get_by_label("Filter")
        expect(field).to_be_in_viewport()
        field.fill("student04")
        expect(page.tab.locator("#filtered")).to_have_text("10 of 200")
        expect(page.tab.locator("#simulations tr:visible")).to_have_count(10)
        # Another event with another row keeps sort order and filter.
        more.append(200)
        expect(page.tab.locator("#filtered")).to_have_text("10 of 201")
        expect(page.tab.locator("#simulations tr:visible .state").first).to_have_text("running")
        expect(page.tab.locator("#simulations tr:visible").first).to_contain_text("student049")
        expect(page.tab.locator("#simulations tr:visible")).to_have_count(10)
        field.fill("student123")
        expect(page.tab.locator("#simulations tr:visible")).to_be_in_viewport()
        field.fill("")
        expect(page.tab.locator("#simulations tr:visible")).to_have_count(201)
        self.assertLess(rows.nth(0).bounding_box()["height"], 260)
        self.assertEqual(page.faults(), [])


if __name__ == "__main__":
    unittest.main()
