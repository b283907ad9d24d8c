"""The monitor pages update live."""

import base64
import re
import unittest
import urllib.error
import urllib.request

from case import BrowserTest
from fleet import SOON, Server
from playwright.sync_api import expect

COLUMNS = [
    "Address",
    "State",
    "Load",
    "Effective load",
    "Instances",
    "Repositories",
    "Version",
    "Latency",
    "Since",
]


class Monitors(BrowserTest):
    simulation = {"blockedRepositories": ["https://github.com/demo/blocked"]}

    def test_a_page_notices_that_its_server_hangs(self):
        page = self.open(self.fleet.session.url("monitor"))
        lamp = page.tab.locator("#live")
        expect(lamp).to_have_text("Live")
        with self.fleet.session.hanging():
            # No connection is closed; the page notices the missing heartbeat.
            expect(lamp).to_contain_text("what you see is old", timeout=60_000)
        expect(lamp).to_have_text("Live")

    def test_a_server_that_is_killed_turns_red_without_a_reload(self):
        page = self.open(self.fleet.session.url("monitor"))
        expect(page.tab.locator("#live")).to_have_text("Live")
        page.tab.evaluate("window.same = true")
        config = self.fleet.other.config
        row = page.tab.locator(f'#servers tr[data-key="{self.fleet.other.address}"]')
        expect(row.locator(".state")).to_have_text("up")
        self.fleet.other.kill()
        expect(row.locator(".state")).to_have_text("down")
        red, green, blue = page.tab.evaluate(
            "state => getComputedStyle(state).color.match(/\\d+/g).map(Number)", row.locator(".state").element_handle()
        )
        self.assertTrue(red > 2 * green and red > 2 * blue, "it is red")
        expect(row.locator(".why")).to_contain_text("no connection")
        expect(page.tab.locator("#glance")).to_contain_text("1 down")
        expect(page.tab.locator("#changes li").first).to_contain_text(self.fleet.other.address)
        self.fleet.servers.remove(self.fleet.other)
        type(self).fleet.other = Server("simulation-server", self.fleet.other.folder, config, self.fleet.environment)
        self.fleet.servers.append(self.fleet.other)
        expect(row.locator(".state")).to_have_text("up")
        self.assertTrue(page.tab.evaluate("window.same"), "the page was loaded again")

    def test_the_tables_can_be_sorted_by_keyboard(self):
        page = self.open(self.fleet.session.url("monitor"))
        first = page.tab.locator("#servers tr th").first
        head = page.tab.get_by_role("columnheader", name="Address")
        texts = sorted([self.fleet.simulation.address, self.fleet.other.address])
        head.get_by_role("button").press("Enter")
        expect(head).to_have_attribute("aria-sort", "ascending")
        expect(first).to_have_text(texts[0])
        head.get_by_role("button").press("Enter")
        expect(head).to_have_attribute("aria-sort", "descending")
        expect(first).to_have_text(texts[1])
        for name in COLUMNS:
            head = page.tab.get_by_role("columnheader", name=name, exact=True)
            head.get_by_role("button").press("Space")
            expect(head).to_have_attribute("aria-sort", "ascending")
            expect(page.tab.locator("th[aria-sort]")).to_have_count(1)

    def test_the_fleet_is_seen_at_one_glance(self):
        page = self.open(self.fleet.session.url("monitor"))
        version = self.fleet.simulation.status()["version"]
        glance = page.tab.locator("#glance")
        for words in ["Available", "of 8 places", "2 of 2 answer", "Web clients", "Mean load"]:
            expect(glance).to_contain_text(words)
        self.assertEqual(page.tab.locator("#servers-title + table thead th").all_inner_texts(), COLUMNS)
        row = page.tab.locator(f'#servers tr[data-key="{self.fleet.other.address}"]')
        for words in ["up", "%", "run", "idle", "wait", "of 4 places", "github.com/demo", version, "ms"]:
            expect(row).to_contain_text(words)
        expect(row.locator("td[data-label=Load] svg.bar")).to_be_visible()
        expect(page.tab.locator("footer")).to_contain_text(f"Version {version}, started ")
        row.get_by_role("link", name=self.fleet.other.address).click()
        expect(page.tab.get_by_role("heading", name="The other one")).to_be_visible()

    def test_a_machine_tells_what_it_is_and_whose_worlds_it_takes(self):
        page = self.open(self.fleet.simulation.url("monitor"))
        expect(page.tab.get_by_role("heading", name="Demonstration")).to_be_visible()
        expect(page.tab.get_by_text("A simulation server that shows two small worlds.")).to_be_visible()
        facts = {
            one.locator("dt").inner_text(): one.locator("dd").inner_text()
            for one in page.tab.locator(".facts > div").all()
        }
        host = self.fleet.simulation.status()["host"]
        self.assertEqual(facts["Host"], host["name"])
        self.assertEqual(facts["Operating system"], host["system"])
        self.assertIn(f"{host['cores']} cores", facts["CPU"])
        self.assertEqual(facts["Allowed repositories"], "https://github.com/demo")
        self.assertEqual(facts["Blocked repositories"], "https://github.com/demo/blocked")
        for name in ["Memory", "Swap", "GPU", "Share idle time"]:
            self.assertTrue(facts[name], name)

    def test_a_simulation_is_listed_with_all_that_is_known_of_it(self):
        viewer, server = self.start_world()
        page = self.open(server.url("monitor"))
        row = page.tab.locator("#simulations tr")
        cell = lambda name: row.locator(f'td[data-label="{name}"]')
        expect(row.locator("th")).to_contain_text("playground.wbt")
        expect(row.locator("th")).to_contain_text("github.com/demo/worlds")
        for name, pattern in [
            ("State", "idle"),
            ("Since", r"\d+:\d\d"),
            ("Time left", r"1 h 59 min"),
            ("CPU", r"\d+ %"),
            ("Memory", r"\d+(\.\d)? MiB"),
            ("Port", str(server.status()["simulations"][0]["port"])),
        ]:
            expect(cell(name)).to_have_text(re.compile(pattern))
        viewer.close()

    def test_charts_have_all_series_and_tell_values(self):
        page = self.open(self.fleet.simulation.url("monitor"))
        series = [
            "Webots running",
            "Webots idle",
            "CPU load",
            "CPU memory",
            "GPU load compute",
            "GPU load memory",
            "GPU memory",
            "Swap",
            "Disk",
            "Network sent",
            "Network received",
        ]
        for name in series:
            expect(page.tab.get_by_label(name)).to_be_checked()
        memory = page.tab.get_by_label("CPU memory")
        line = page.tab.locator("#charts figure").first.locator("polyline.s1")
        expect(line).not_to_have_attribute("points", "")
        memory.uncheck()
        expect(line).to_have_attribute("points", "")
        memory.check()
        chart = page.tab.locator("#charts figure svg[role=slider]").first
        box = chart.bounding_box()
        page.tab.mouse.move(box["x"] + box["width"] - 30, box["y"] + 80)
        moment = page.tab.locator(".moment").first
        expect(moment).to_contain_text("at ")
        expect(page.tab.locator("#charts figure").first.locator(".legend b").first).to_contain_text("%")
        page.tab.mouse.move(0, 0)
        expect(moment).to_have_text("now")
        chart.press("ArrowLeft")
        expect(moment).to_contain_text("at ")
        # For screen readers.
        self.assertRegex(chart.get_attribute("aria-valuetext"), r"^at .*: CPU load \d+\.\d %, .*Disk \d+\.\d %$")
        chart.press("Escape")
        expect(moment).to_have_text("now")

    def test_the_output_of_a_simulation_is_shown_on_demand(self):
        viewer, server = self.start_world()
        page = self.open(server.url("monitor"))
        # The simulation of an earlier visitor may still be listed, waiting for its client.
        page.tab.locator("#simulations").get_by_role("link", name="Last lines").last.click()
        dialog = page.tab.get_by_role("dialog")
        expect(dialog).to_contain_text("Output of playground.wbt")
        expect(dialog.locator("pre")).not_to_have_text("Loading …")
        self.assertEqual(page.faults(), [])
        page.tab.keyboard.press("Escape")
        expect(dialog).to_be_hidden()
        viewer.close()

    def test_the_pages_are_whole_without_javascript(self):
        page = self.open(self.fleet.session.url("monitor"), javascript=False)
        expect(page.tab.locator("#servers tr")).to_have_count(2)
        self.assertIn('<meta http-equiv="refresh"', page.tab.content())
        page = self.open(self.fleet.simulation.url("monitor"), javascript=False)
        expect(page.tab.locator("#glance")).to_contain_text("Current load")
        page = self.open(self.fleet.session.url("viewer"), javascript=False)
        self.assertIn("This page needs JavaScript", page.tab.content())

    def test_a_page_finds_its_server_again(self):
        page = self.browser.page()
        self.addCleanup(page.close)
        page.tab.goto(self.fleet.session.url("monitor"))
        live = page.tab.locator("#live")
        expect(live).to_have_text("Live")
        config = self.fleet.session.config
        self.fleet.session.stop()
        expect(live).to_contain_text("No connection since")
        type(self).fleet.session = Server("session-server", self.fleet.session.folder, config, self.fleet.environment)
        self.fleet.servers.append(self.fleet.session)
        expect(live).to_have_text("Live")
        expect(page.tab.locator("#servers .state.up")).to_have_count(2)


class Locked(BrowserTest):
    simulation = {"adminPassword": "secret"}

    def test_output_needs_the_password_where_there_is_one(self):
        viewer, server = self.start_world()
        url = server.url(f"output?id={server.status()['simulations'][0]['id']}")
        with self.assertRaises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(url, timeout=SOON)
        self.assertEqual(refused.exception.code, 401)
        login = base64.b64encode(b"admin:secret").decode()
        with urllib.request.urlopen(urllib.request.Request(url, headers={"Authorization": f"Basic {login}"})) as answer:
            self.assertEqual(answer.status, 200)
        viewer.close()


if __name__ == "__main__":
    unittest.main()
