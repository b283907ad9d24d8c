"""Names of visitors: the field on the viewer page, what the browser keeps of it, and who needs none."""

import unittest

from case import BrowserTest
from fleet import until
from playwright.sync_api import expect


class Names(BrowserTest):
    session = {"askName": "required", "userHeader": "X-Forwarded-User"}

    def connect(self, page):
        expect(page.tab.locator("#availability")).to_contain_text("Available")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()

    def test_a_name_is_necessary_and_kept(self):
        page = self.open(self.fleet.session.url("viewer"))
        field = page.tab.get_by_label("Your name")
        self.connect(page)
        self.assertFalse(field.evaluate("field => field.checkValidity()"))
        expect(page.tab.locator("[data-step=session].done, [data-step=simulation].done")).to_have_count(0)
        self.assertEqual(page.faults(), [])
        field.fill("Nora 14")
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        expect(page.tab.locator("#visitor")).to_contain_text("The administrator sees you as Nora 14.")
        servers = (self.fleet.simulation, self.fleet.other)
        log = lambda: "".join(server.log.read_text() for server in servers)
        until("the log has the name", lambda: 'calls itself "Nora 14"' in log())
        page.tab.get_by_role("button", name="Disconnect").click()
        # The browser keeps it; a link may have another one.
        page.tab.goto(self.fleet.session.url("viewer"))
        expect(page.tab.get_by_label("Your name")).to_have_value("Nora 14")
        page.tab.goto(self.fleet.session.url("viewer?name=Anna"))
        expect(page.tab.get_by_label("Your name")).to_have_value("Anna")
        other = self.open(self.fleet.session.url("viewer"))
        expect(other.tab.get_by_label("Your name")).to_have_value("")

    def test_a_user_of_a_sign_in_needs_none(self):
        page = self.open("about:blank")
        signed_in = {"X-Forwarded-User": "nora@school.example"}
        page.tab.route("**/viewer", lambda route: route.continue_(headers={**route.request.headers, **signed_in}))
        page.tab.goto(self.fleet.session.url("viewer"))
        expect(page.tab.get_by_label("Your name")).to_have_count(0)
        self.connect(page)
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()


if __name__ == "__main__":
    unittest.main()
