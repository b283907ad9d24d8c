"""The viewer resumes after a reload, Back or a lost connection, and shows the correct state in between."""

import itertools
import json
import re
import unittest

from case import KEPT, Running, kept, seconds
from fleet import ROOT, WORLD, free_ports, until
from playwright.sync_api import expect


class ComingBack(Running):
    def test_after_a_reload_and_back_the_clock_goes_on(self):
        page, server = self.running()
        pid, before = self.pid(server), seconds(page)
        self.assertIn("viewer?url=https%3A%2F%2Fgithub.com%2Fdemo", page.tab.url)
        page.tab.reload()
        self.goes_on(page, server, pid, before)
        before = seconds(page)
        page.tab.goto(self.fleet.session.url("monitor"))
        page.tab.go_back()
        self.goes_on(page, server, pid, before)
        token = kept(page)["token"]
        self.assertRegex(token, "^[0-9a-f]{48}$")
        self.assertFalse([url for url in page.asked if token in url], "a token in a URL")
        self.assertNotIn(token, server.log.read_text())
        self.assertEqual(page.faults(), [])
        self.leaves_nothing(page, server)
        # An ended simulation is not resumed.
        page.tab.reload()
        expect(page.tab.locator("#availability.on")).to_be_visible()
        expect(page.tab.get_by_role("button", name="Connect", exact=True)).to_be_enabled()

    def test_links_of_the_header_open_another_tab_while_a_simulation_runs(self):
        page, server = self.running()
        with page.context.expect_page() as opened:
            page.tab.get_by_role("link", name="Monitor").click()
        opened.value.close()
        self.assertEqual(len(server.status()["simulations"]), 1)
        self.leaves_nothing(page, server)
        page.tab.get_by_role("link", name="Monitor").click()
        expect(page.tab).to_have_url(re.compile("/monitor$"))

    def test_two_tabs_with_one_token_are_one_simulation_and_the_first_is_told(self):
        page, server = self.running()
        pid = self.pid(server)
        stored = page.tab.evaluate(f"sessionStorage.getItem('{KEPT}')")
        other = self.browser.page()
        self.addCleanup(other.close)
        # Like a tab that the browser has duplicated.
        other.tab.add_init_script(
            f"sessionStorage.getItem('{KEPT}') ?? sessionStorage.setItem('{KEPT}', {json.dumps(stored)})"
        )
        other.tab.goto(self.fleet.session.url("viewer"))
        self.goes_on(other, server, pid, 0)
        expect(page.tab.locator("#problem-text")).to_contain_text("taken over elsewhere")
        expect(page.tab.locator("#problem-advice")).to_contain_text("Another tab")
        other.tab.get_by_role("button", name="Disconnect").click()
        until("the simulation is gone", lambda: not server.status()["simulations"])

    def test_two_tabs_are_two_simulations(self):
        first, _ = self.running()
        second, _ = self.running()
        servers = (self.fleet.simulation, self.fleet.other)
        self.assertEqual(sum(len(server.status()["simulations"]) for server in servers), 2)
        expect(first.tab.locator("footer")).to_contain_text("two tabs are two simulations")
        for page in (first, second):
            page.tab.get_by_role("button", name="Disconnect").click()
        until("both are gone", lambda: not any(server.status()["simulations"] for server in servers))

    def test_a_server_that_hangs_is_told_and_the_simulation_is_found_again(self):
        page, server = self.running()
        pid, before = self.pid(server), seconds(page)
        # Silences the stream too: in reality it shares the network.
        page.tab.get_by_role("button", name="Pause", exact=True).click()
        expect(page.tab.locator("#mode")).to_have_text("paused")
        with server.hanging():
            expect(page.tab.locator("#notice-text")).to_contain_text("No connection for")
            expect(page.tab.locator("#notice-advice")).to_contain_text("Your simulation waits up to another")
            expect(page.tab.locator("#availability")).to_contain_text("No connection")
            expect(page.tab.locator("#mode")).to_have_text("no connection")
            self.assertEqual(page.faults(), [])
        expect(page.tab.locator("#notice")).to_be_hidden()
        expect(page.tab.locator("#availability.on")).to_be_visible()
        expect(page.tab.locator("#mode")).to_have_text("paused")
        self.assertGreaterEqual(seconds(page), before)
        self.assertEqual(self.pid(server), pid)
        self.leaves_nothing(page, server)

    def test_after_20_seconds_offline_it_is_found_again_by_itself(self):
        self.may_complain = True
        page, server = self.running()
        pid, before = self.pid(server), seconds(page)
        page.context.set_offline(True)
        expect(page.tab.locator("#notice-text")).to_contain_text(re.compile(r"No connection for [2-5]\d seconds"))
        notice = page.tab.locator("#notice").inner_text()
        away = int(re.search(r"for (\d+) seconds", notice)[1])
        left = re.search(r"another 4 minutes(?:, (\d+) seconds?)?", notice)
        self.assertAlmostEqual(away + 240 + int(left[1] or 0), 300, delta=1)
        page.context.set_offline(False)
        self.goes_on(page, server, pid, before + 10)
        self.leaves_nothing(page, server)

    def test_the_example_of_the_protocol_starts_comes_back_and_leaves(self):
        text = (ROOT / "docs/protocol.md").read_text()
        example = text.split("```js\n")[1].split("```")[0]
        self.assertLessEqual(len(example.splitlines()), 30)
        # A page without a content security policy and without a script.
        page = self.browser.page()
        self.addCleanup(page.close)
        tab = page.tab
        tab.goto(self.fleet.session.url("load"))
        begin = """([example, fleet, world]) => {
            window.heard = [];
            const simulate = new Function(`return ${example}`)();
            simulate(fleet, world, (kind, more) => window.heard.push([kind, more]));
        }"""
        arguments = [example.strip(), self.fleet.session.url("").rstrip("/"), WORLD.format("playground")]
        heard = lambda: [one[0] for one in tab.evaluate("window.heard.map(([kind]) => [kind])")]
        tab.evaluate(begin, arguments)
        until("Webots is ready", lambda: "webots" in heard())
        until("it is kept", lambda: tab.evaluate("JSON.parse(sessionStorage.getItem('simulation'))?.token"))
        servers = (self.fleet.simulation, self.fleet.other)
        (server,) = [one for one in servers if one.status()["simulations"]]
        pid = self.pid(server)
        tab.reload()
        tab.evaluate(begin, arguments)
        until("it is back", lambda: "webots" in heard())
        self.assertEqual(self.pid(server), pid)
        tab.evaluate("window.heard.find(([kind]) => kind === 'leave')[1]()")
        until("the simulation is gone", lambda: not server.status()["simulations"])
        until("it is told", lambda: "error" in heard())
        self.assertIsNone(tab.evaluate("sessionStorage.getItem('simulation')"))
        tab.evaluate(begin, [*arguments[:2], "https://github.com/stranger/worlds/blob/main/worlds/a.wbt"])
        until(
            "it is refused",
            lambda: tab.evaluate("window.heard.some(([kind, more]) => kind === 'error' && /accepts/.test(more))"),
        )


class Starting(Running):
    """Webots does not start before there is a gate."""

    @classmethod
    def make_fleet(cls):
        fleet = cls.fleet_of_script('until [ -e "$folder/gate" ]; do sleep 0.1; done\nexec "$simulator" "$@"')
        cls.gate = cls.webots.with_name("gate")
        return fleet

    def test_a_link_starts_it_and_a_reload_at_any_time_goes_on(self):
        page = self.open(self.fleet.session.url(f"viewer?url={WORLD.format('playground')}&start=1&play=1"))
        servers = (self.fleet.simulation, self.fleet.other)
        ids = lambda: [one["id"] for server in servers for one in server.status()["simulations"]]
        before = None
        for _ in range(3):
            expect(page.tab.locator("#step-launch.doing")).to_be_visible()
            # A screen reader hears each step.
            expect(page.tab.locator("#spoken")).to_contain_text("Launch: ")
            self.assertEqual(page.faults(), [])
            before = before or ids()
            self.assertEqual(ids(), before)
            page.tab.reload()
        self.gate.touch()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        expect(page.tab.locator("#spoken")).to_have_text("The simulation is ready.")
        expect(page.tab.locator("#mode")).to_have_text("real time")
        expect(page.tab.locator("#view")).to_be_in_viewport()
        self.assertEqual(ids(), before)
        page.tab.get_by_role("button", name="Full screen").click()
        expect(page.tab.get_by_role("button", name="Leave full screen")).to_be_visible()
        self.assertEqual(page.faults(), [])
        page.tab.get_by_role("button", name="Leave full screen").click()
        page.tab.get_by_role("button", name="Disconnect").click()
        until("the simulation is gone", lambda: not ids())
        # Who has left is not led back, but a link starts a new one.
        page.tab.goto(self.fleet.session.url("viewer"))
        expect(page.tab.locator("#availability.on")).to_be_visible()
        self.assertEqual(ids(), [])


class Busy(Running):
    # Otherwise the session server would take the port of the only slot.
    session = {"port": free_ports(64) + 63}
    simulation = {"maxConnections": 1, "waitingLine": 0}

    def test_who_finds_all_servers_busy_waits_and_starts_by_itself_or_stops_waiting(self):
        first, _ = self.running()
        second, _ = self.running()
        third = self.open(self.fleet.session.url("viewer"))
        expect(third.tab.locator("#availability")).not_to_contain_text("Connecting")
        third.tab.get_by_role("button", name="Playground").click()
        third.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(third.tab.locator("#notice-text")).to_have_text("All servers are busy.")
        expect(third.tab.locator("#notice-advice")).to_contain_text("It starts by itself when it is your turn.")
        expect(third.tab.locator("#problem")).to_be_hidden()
        self.assertEqual(third.faults(), [])
        third.tab.get_by_role("button", name="Stop waiting").click()
        expect(third.tab.locator("#notice")).to_be_hidden()
        third.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(third.tab.locator("#notice-text")).to_have_text("All servers are busy.")
        first.tab.get_by_role("button", name="Disconnect").click()
        expect(third.tab.locator("[data-step=simulation].done")).to_be_visible()
        expect(third.tab.locator("#notice")).to_be_hidden()
        for page in (second, third):
            page.tab.get_by_role("button", name="Disconnect").click()


class InLine(Running):
    key = "a secret of these tests"
    # The load of a busy machine must not fill a server.
    # Nor must the session server take the port of a slot.
    session = {"fleetKey": key, "loadThreshold": 1000, "port": free_ports(64) + 63}
    simulation = {"maxConnections": 1, "fleetKey": key}

    def watch(self, page):
        """Records what the page tells screen readers from now on, and how often it rings; `isAway` hides it behind
        another tab, which a browser without a window never does."""
        page.tab.evaluate("""() => {
          [window.said, window.rings, window.isAway] = [[], 0, false];
          const Sound = window.AudioContext;
          window.AudioContext = class extends Sound { constructor() { super(); window.rings += 1; } };
          Object.defineProperty(document, 'hidden', { get: () => window.isAway });
        }""")
        page.tab.locator("#spoken").evaluate("""(spoken) => {
          const record = (changes) => changes.map(({ addedNodes }) => window.said.push(addedNodes[0]?.textContent));
          new MutationObserver(record).observe(spoken, { childList: true });
        }""")

    def join(self):
        """A page that asks for a world."""
        page = self.open(self.fleet.session.url("viewer"))
        self.watch(page)
        expect(page.tab.locator("#availability")).not_to_contain_text("Connecting")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        return page

    def test_six_pages_wait_in_order_one_reloads_one_goes_away_and_one_is_in_the_background(self):
        running = [self.running()[0], self.running()[0]]
        line = []
        for ahead in range(6):
            page = self.join()
            expect(page.tab.locator("#notice-text")).to_have_text("All servers are busy.")
            expect(page.tab).to_have_title(re.compile(rf"^\({ahead + 1}\) "))
            line.append(page)
        words = ["you are next", "1 client is ahead of you", "2 clients are ahead of you"]
        for page, word in zip(line, words, strict=False):
            expect(page.tab.locator("#step-session small")).to_contain_text(word)
            # Screen readers hear it.
            expect(page.tab.locator("#spoken")).to_contain_text(word)
        line[2].tab.reload()
        self.watch(line[2])
        background = line[3]
        background.tab.evaluate("window.isAway = true")
        expect(line[2].tab).to_have_title(re.compile(r"^\(3\) "))
        line.pop(4).tab.get_by_role("button", name="Stop waiting").click()
        expect(line[4].tab).to_have_title(re.compile(r"^\(5\) "))
        for page in line:
            running.pop(0).tab.get_by_role("button", name="Disconnect").click()
            expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
            # Screen readers hear that it is its turn; there is a sound, and another title for who sees another tab.
            self.assertEqual(page.tab.evaluate("said").count("It is your turn."), 1, page.tab.evaluate("said"))
            self.assertEqual(page.tab.evaluate("rings"), 1)
            expect(page.tab).to_have_title(re.compile("^It is your turn" if page is background else "^Try a world"))
            others = line[line.index(page) + 1 :]
            for ahead, other in enumerate(others):
                expect(other.tab).to_have_title(re.compile(rf"^\({ahead + 1}\) "))
            running.append(page)
        # They heard each position; who looks at the page again sees its own title.
        heard = background.tab.evaluate("said")
        positions = [found[0] for found in map(re.compile("you are next|[0-9]+ client").search, heard) if found]
        # With another estimate a position is told again.
        positions = [position for position, _ in itertools.groupby(positions)]
        # While a page ahead reloads, it is not in the line: if that takes long, others hear it, and that it is back.
        moved = positions[-3:]
        self.assertEqual(moved, ["2 client", "1 client", "you are next"], positions)
        self.assertLessEqual(set(positions[:-3]), {"2 client", "3 client"}, positions)
        background.tab.evaluate("window.isAway = false; document.dispatchEvent(new Event('visibilitychange'))")
        expect(background.tab).to_have_title(re.compile("^Try a world"))
        for page in running:
            self.assertEqual(page.faults(), [])
            page.tab.get_by_role("button", name="Disconnect").click()


if __name__ == "__main__":
    unittest.main()
