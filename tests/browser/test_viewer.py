"""The viewer: from the availability to a moving scene."""

import unittest

from case import BrowserTest, picture, seconds
from fleet import WORLD, until
from playwright.sync_api import expect


class Viewing(BrowserTest):
    def test_the_view_turns_by_keyboard_and_pointer(self):
        page, _ = self.start_world("Carousel")
        view = page.tab.locator("#view")
        first = picture(page)
        for key in ["ArrowLeft", "ArrowUp", "+", "Shift+ArrowRight"]:
            before = picture(page)
            view.press(key)
            until(f"{key} changes the view", lambda: picture(page) != before)
        before = picture(page)
        box = view.bounding_box()
        page.tab.mouse.move(box["x"] + 200, box["y"] + 200)
        page.tab.mouse.down()
        page.tab.mouse.move(box["x"] + 300, box["y"] + 220)
        page.tab.mouse.up()
        until("dragging changes the view", lambda: picture(page) != before)
        # Clicking the button also removes the focus ring, which is part of the picture.
        page.tab.get_by_role("button", name="Home view").click()
        until("the view is the first again", lambda: picture(page) == first)

    def test_disconnect_ends_the_simulation(self):
        page, server = self.start_world()
        # A page that a test before has closed may come back for some time: its simulation waits.
        (own,) = (one["id"] for one in server.status()["simulations"] if not one.get("awayUntil"))
        page.tab.get_by_role("button", name="Disconnect").click()
        expect(page.tab.locator("#stage")).to_contain_text("it has ended")
        until("the simulation is gone", lambda: own not in [one["id"] for one in server.status()["simulations"]])
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()

    def test_a_failure_is_told_in_words_with_what_to_do(self):
        table = [
            (
                "https://github.com/stranger/worlds/blob/main/worlds/a.wbt",
                "No simulation server accepts",
                "monitor page",
            ),
            ("https://github.com/demo/worlds/blob/main/a.wbt", "worlds", "Copy the address"),
            (WORLD.format("missing"), "missing.wbt", "Look whether"),
            ("https://github.com/demo/nothing/blob/main/worlds/a.wbt", "nothing", "Look whether"),
        ]
        page = self.open(self.fleet.session.url("viewer"))
        expect(page.tab.locator("#availability")).to_contain_text("Available")
        for world, words, what_to_do in table:
            with self.subTest(world):
                page.tab.get_by_label("URL of a world").fill(world)
                page.tab.get_by_role("button", name="Connect", exact=True).click()
                expect(page.tab.locator("#problem-text")).to_contain_text(words)
                expect(page.tab.locator("#problem-advice")).to_contain_text(what_to_do)
                expect(page.tab.locator(".steps .failed")).to_have_count(1)
                expect(page.tab.get_by_role("button", name="Connect", exact=True)).to_be_enabled()

    def test_a_session_server_that_hangs_is_told_and_its_late_answer_is_nobodys(self):
        page = self.open(self.fleet.session.url("viewer"))
        expect(page.tab.locator("#availability")).to_contain_text("Available")
        connect = page.tab.get_by_role("button", name="Connect", exact=True)
        with self.fleet.session.hanging():
            page.tab.get_by_label("URL of a world").fill("https://github.com/stranger/worlds/blob/main/worlds/a.wbt")
            connect.click()
            expect(page.tab.locator("#problem-text")).to_contain_text("does not answer")
            expect(connect).to_be_enabled()
        # The refusal of the first world arrives now, before the answer to this one.
        page.tab.get_by_role("button", name="Playground").click()
        connect.click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        expect(page.tab.locator("#problem")).to_be_hidden()

    def test_the_scene_is_requested_once_by_the_kind_that_the_server_tells(self):
        page = self.open(self.fleet.session.url("viewer"))
        sent = self.sent_over_streams(page)
        expect(page.tab.locator("#availability")).to_contain_text("Available")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        # Time runs, so that updates come too.
        page.tab.get_by_role("button", name="Play", exact=True).click()
        until("time passes", lambda: seconds(page) > 3)
        # The world is one of R2025a.
        self.assertEqual(sent, ["w3d", "real-time:-1"])

    def test_on_a_phone_the_scene_comes_into_sight(self):
        page, _ = self.start_world(width=360, height=740)
        expect(page.tab.locator("#view")).to_be_in_viewport(ratio=0.9)

    def test_a_link_can_name_the_world(self):
        page = self.open(self.fleet.session.url(f"viewer?url={WORLD.format('carousel')}"))
        expect(page.tab.get_by_label("URL of a world")).to_have_value(WORLD.format("carousel"))


if __name__ == "__main__":
    unittest.main()
