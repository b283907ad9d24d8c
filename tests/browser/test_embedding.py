"""The pages that docs/embedding.md prints, served from another site."""

import os
import pathlib
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import unittest
import urllib.request

from case import BrowserTest
from firefox import MISSING, Firefox
from fleet import ROOT, SOON, WORLD, free_ports, until
from playwright.sync_api import expect
from site_of_others import PRINTED, Site, printed

SHOWN = "[data-step=simulation].done"
LANGUAGES = ["en", "de", "fr", "es", "zh", "ja"]
TOOLS = ROOT / "tests/assets/node_modules"
REACT_PAGE = f"""
import {{ useState }} from 'react';
import {{ createRoot }} from 'react-dom/client';
import {{ Simulation }} from './simulation.jsx';

function Page() {{
  const [isThere, setThere] = useState(true);
  const [end, setEnd] = useState();
  return (
    <>
      <h1>Robots</h1>
      {{isThere && <Simulation autostart world="{PRINTED}" onEnded={{setEnd}} />}}
      <p id="told">{{end?.message}}</p>
      <button onClick={{() => setThere(false)}}>Close</button>
    </>
  );
}}
createRoot(document.querySelector('main')).render(<Page />);
"""
in_firefox = unittest.skipIf(MISSING, MISSING)
with_react = unittest.skipUnless((TOOLS / "esbuild").exists(), "tests/lint.sh fetches React")


class Embedding(BrowserTest):
    """The base: a site of others, beside the fleet."""

    elsewhere = frozenset({"localhost"})

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.site = cls.enterClassContext(Site(cls.fleet))

    def visit(self, name, text, **options):
        return self.open(self.site.put(name, text), **options)

    def firefox(self, url):
        """A Firefox that shows a page of the site, and a function that looks at what an element of it shows."""
        tab = self.enterContext(Firefox())
        self.addCleanup(lambda: self.may_complain or self.assertEqual(tab.complaints, [], "the console"))
        tab.goto(url)
        return tab, lambda name, selector: f"document.getElementById('{name}')?.shadowRoot?.querySelector('{selector}')"

    def in_order(self, page, frame=None):
        self.assertEqual(page.faults(frame), [])
        self.assertLessEqual(page.overflow(frame), 0, "pixels too wide")

    def fills_the_screen(self, page, place):
        """The element in this place does, and no longer."""
        place.get_by_role("button", name="Full screen").click()
        expect(place.get_by_role("button", name="Leave full screen")).to_be_visible()
        self.assertTrue(page.tab.evaluate("document.fullscreenElement !== null"))
        self.assertEqual(page.faults(None if place is page.tab else place), [])
        place.get_by_role("button", name="Leave full screen").click()
        expect(place.get_by_role("button", name="Full screen")).to_be_visible()

    def simulations(self):
        """The simulations of all servers."""
        servers = (self.fleet.simulation, self.fleet.other)
        return [one for server in servers for one in server.status()["simulations"]]


class PrintedPages(Embedding):
    def test_a_page_starts_reloads_goes_on_and_ends(self):
        page = self.visit("page", printed("A page"))
        tab = page.tab
        expect(tab.locator("#availability.on")).to_be_visible()
        self.assertEqual(page.faults(), [])
        tab.get_by_role("button", name="Connect").click()
        expect(tab.locator(SHOWN)).to_be_visible()
        expect(tab.locator("#spoken")).to_have_text("The simulation is ready.")
        tab.get_by_role("button", name="Play").click()
        expect(tab.locator("#told")).to_have_text(re.compile(r"^[1-9]\d*\.\d seconds$"))
        self.assertEqual(page.faults(), [])
        self.fills_the_screen(page, tab)
        (before,) = self.simulations()
        tab.reload()
        expect(tab.locator(SHOWN)).to_be_visible()
        expect(tab.locator("#mode")).to_have_text("real time")
        (after,) = self.simulations()
        self.assertEqual((before["id"], before["pid"]), (after["id"], after["pid"]))
        # As a script of the page steers it.
        tab.evaluate("document.getElementById('robot').pause()")
        expect(tab.locator("#mode")).to_have_text("paused")
        self.assertEqual(tab.evaluate("document.getElementById('robot').state"), "running")
        tab.evaluate("document.getElementById('robot').reset()")
        expect(tab.locator("#clock")).to_have_text("0:00.000")
        tab.get_by_role("button", name="Disconnect").click()
        expect(tab.locator("#told")).to_have_text("Goodbye.")
        expect(tab.get_by_role("button", name="Connect")).to_be_focused()
        until("it is gone", lambda: not self.simulations())
        # Nothing is left of it after a reload.
        tab.reload()
        expect(tab.get_by_role("button", name="Connect")).to_be_visible()
        self.assertEqual(self.simulations(), [])

    @in_firefox
    def test_in_firefox_a_page_starts_reloads_goes_on_and_ends(self):
        tab, part = self.firefox(self.site.put("page", printed("A page")))
        until("it is available", lambda: tab.evaluate(f"!!{part('robot', '#availability.on')}"))
        tab.evaluate(part("robot", "[part=start]") + ".click()")
        until("it is shown", lambda: tab.evaluate(f"!!{part('robot', SHOWN)}"))
        tab.evaluate("document.getElementById('robot').play()")
        told = "document.getElementById('told').textContent"
        until("time passes", lambda: re.search(r"^[1-9]\d*\.\d seconds$", tab.evaluate(told)))
        (before,) = self.simulations()
        tab.reload()
        mode = f"{part('robot', '#mode')}?.textContent"
        until("it goes on", lambda: tab.evaluate(mode) == "real time")
        (after,) = self.simulations()
        self.assertEqual((before["id"], before["pid"]), (after["id"], after["pid"]))
        tab.evaluate(part("robot", "[part=leave]") + ".click()")
        until("it ends", lambda: tab.evaluate(told) == "Goodbye.")
        until("it is gone", lambda: not self.simulations())

    @in_firefox
    def test_in_firefox_two_elements_are_two_simulations_and_the_removal_of_one_ends_it(self):
        tab, part = self.firefox(self.site.put("race", printed("Two simulations")))
        for side in ("left", "right"):
            mode = f"{part(side, '#mode')}?.textContent"
            until(f"{side} runs", lambda mode=mode: tab.evaluate(mode) == "real time")
        self.assertEqual(len({one["id"] for one in self.simulations()}), 2)
        tab.evaluate("document.getElementById('give-up').click()")
        until("one has ended", lambda: len(self.simulations()) == 1)
        self.assertEqual(tab.evaluate("document.getElementById('left').state"), "running")
        tab.evaluate("document.getElementById('left').remove()")
        until("the other has ended", lambda: not self.simulations())

    def put_react(self):
        """Serves a page with the printed component; returns its URL."""
        with tempfile.TemporaryDirectory() as folder:
            sources = pathlib.Path(folder)
            (sources / "simulation.jsx").write_text(printed("React", "jsx"))
            (sources / "page.jsx").write_text(REACT_PAGE)
            options = ["--bundle", "--format=esm", "--jsx=automatic", "--log-level=error"]
            command = [TOOLS / ".bin/esbuild", sources / "page.jsx", *options, "--define:process.env.NODE_ENV='test'"]
            environment = {**os.environ, "NODE_PATH": str(TOOLS)}
            bundle = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
        self.site.put("page.js", bundle)
        main = "<main></main><script type='module' src='page.js'></script>"
        return self.site.put("react", f"<!DOCTYPE html><html lang='en'><title>React</title>{main}")

    @with_react
    def test_a_component_of_react_starts_tells_its_end_and_ends_with_its_page(self):
        page = self.open(self.put_react())
        expect(page.tab.locator(SHOWN)).to_be_visible()
        self.assertEqual(page.faults(), [])
        page.tab.get_by_role("button", name="Disconnect").click()
        expect(page.tab.locator("#told")).to_contain_text("ended")
        until("it is gone", lambda: not self.simulations())
        page.tab.get_by_role("button", name="Connect").click()
        expect(page.tab.locator(SHOWN)).to_be_visible()
        page.tab.get_by_role("button", name="Close").click()
        until("it is gone again", lambda: not self.simulations())

    @in_firefox
    @with_react
    def test_in_firefox_a_component_of_react_starts_tells_its_end_and_ends_with_its_page(self):
        tab, _ = self.firefox(self.put_react())
        root = "document.querySelector('webots-simulation')?.shadowRoot"
        is_shown = f"!!{root}?.querySelector('{SHOWN}')"
        until("it is shown", lambda: tab.evaluate(is_shown))
        tab.evaluate(f"{root}.querySelector('[part=leave]').click()")
        told = "document.getElementById('told').textContent"
        until("its end is told", lambda: "ended" in tab.evaluate(told))
        until("it is gone", lambda: not self.simulations())
        tab.evaluate(f"{root}.querySelector('[part=start]').click()")
        until("it is shown again", lambda: tab.evaluate(is_shown))
        tab.evaluate("document.querySelector('main button').click()")
        until("it is gone again", lambda: not self.simulations())

    def test_a_page_whose_policy_allows_what_the_guide_names(self):
        fleet = self.fleet.session.url("").rstrip("/")
        policy = (
            f"default-src 'none'; script-src 'unsafe-inline' {fleet}; frame-src {fleet}; "
            f"connect-src {fleet} http://127.0.0.1:* ws://127.0.0.1:*"
        )
        meta = f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n<title>'
        page = self.visit("page", printed("A page").replace("<title>", meta))
        page.tab.get_by_role("button", name="Connect").click()
        expect(page.tab.locator(SHOWN)).to_be_visible()
        self.assertEqual(page.faults(), [])
        page.tab.get_by_role("button", name="Disconnect").click()
        until("it is gone", lambda: not self.simulations())

    def test_a_failure_has_a_code_for_the_page_and_words_for_its_visitor(self):
        text = printed("A page").replace("playground.wbt", "missing.wbt")
        page = self.visit("missing", text)
        tab = page.tab
        tab.evaluate("document.getElementById('robot').addEventListener('ended', (e) => { window.end = e.detail; })")
        expect(tab.locator("#availability.on")).to_be_visible()
        tab.evaluate(f"document.getElementById('robot').start('{WORLD.format('missing')}')")
        expect(tab.locator("#problem-advice")).to_contain_text("Look whether")
        end = tab.evaluate("window.end")
        self.assertEqual((end["code"], end["blame"], end["retry"]), ("world-not-found", "user", "no"))
        expect(tab.locator("#told")).to_contain_text("missing.wbt")

    def test_a_page_goes_on_by_the_code_of_an_end(self):
        page = self.visit("codes", printed("A page").replace("</html>", printed("How it ends")))
        tab = page.tab
        tab.evaluate("window.ready = 0; robot.addEventListener('ready', () => { ready += 1; })")
        expect(tab.locator("#availability.on")).to_be_visible()
        tab.get_by_role("button", name="Connect").click()
        for number in (1, 2, 3):
            tab.wait_for_function("number => window.ready === number", arg=number)
            (one,) = self.simulations()
            os.kill(one["pid"], signal.SIGKILL)
        # Not for ever.
        expect(tab.locator("#told")).to_contain_text("SIGKILL")
        expect(tab.locator("#problem")).to_be_visible()
        until("nothing runs", lambda: not self.simulations())
        tab.get_by_role("button", name="Connect").click()
        expect(tab.locator(SHOWN)).to_be_visible()
        tab.get_by_role("button", name="Disconnect").click()
        expect(tab.locator("#told")).to_have_text("What did the robot do? Please write it down.")
        until("it is gone", lambda: not self.simulations())

    def test_a_call_before_the_element_is_ready_prevents_neither_its_start_nor_its_return(self):
        call = """<script type="module">
          await customElements.whenDefined('webots-simulation');
          document.getElementById('robot').play();
        </script>"""
        page = self.visit("eager", printed("A page").replace('id="robot"', 'id="robot" autostart') + call)
        tab = page.tab
        expect(tab.locator("#mode")).to_have_text("real time")
        (before,) = self.simulations()
        tab.reload()
        expect(tab.locator("#mode")).to_have_text("real time")
        (after,) = self.simulations()
        self.assertEqual(before["id"], after["id"])
        tab.evaluate("document.getElementById('robot').stop()")
        until("it is gone", lambda: not self.simulations())

    def test_two_elements_are_two_simulations_and_the_removal_of_one_ends_it(self):
        page = self.visit("race", printed("Two simulations"))
        tab = page.tab
        expect(tab.locator(f"#left {SHOWN}")).to_be_visible()
        expect(tab.locator(f"#right {SHOWN}")).to_be_visible()
        for side in ("left", "right"):
            expect(tab.locator(f"#{side} #mode")).to_have_text("real time")
        self.assertEqual(page.faults(), [])
        before = {one["id"] for one in self.simulations()}
        self.assertEqual(len(before), 2)
        tab.reload()
        for side in ("left", "right"):
            expect(tab.locator(f"#{side} #mode")).to_have_text("real time")
        self.assertEqual({one["id"] for one in self.simulations()}, before)
        # Who moves an element in its page keeps its simulation.
        tab.evaluate("document.querySelector('main').prepend(document.getElementById('left'))")
        tab.get_by_role("button", name="Give up").click()
        until("one has ended", lambda: len(self.simulations()) == 1)
        expect(tab.locator("#left #mode")).to_have_text("real time")
        tab.evaluate("document.getElementById('left').stop()")
        until("the other has ended", lambda: not self.simulations())

    def test_elements_without_an_id_keep_apart_when_one_is_removed_and_another_added(self):
        page = self.visit("race", re.sub(' id="(left|right)"', "", printed("Two simulations")))
        tab = page.tab
        modes = tab.locator("webots-simulation #mode")
        expect(modes).to_have_text(["real time"] * 2)
        before = {one["id"] for one in self.simulations()}
        tab.evaluate("""() => {
          const [first] = document.querySelectorAll('webots-simulation');
          const another = first.cloneNode();
          first.remove();
          document.querySelector('main').append(another);
        }""")
        until("one is replaced", lambda: len({one["id"] for one in self.simulations()} - before) == 1)
        expect(modes).to_have_text(["real time"] * 2)
        self.assertEqual(len({one["id"] for one in self.simulations()} & before), 1)
        # Those of a component, in a shadow root of its own, too.
        tab.evaluate("""() => {
          const [one] = document.querySelectorAll('webots-simulation');
          const component = document.createElement('div');
          component.attachShadow({ mode: 'open' }).append(one.cloneNode(), one.cloneNode());
          document.body.append(component);
        }""")
        expect(modes).to_have_text(["real time"] * 4)
        self.assertEqual(len(self.simulations()), 4)
        tab.evaluate("""() => {
          const component = document.body.lastElementChild;
          for (const root of [document, component.shadowRoot])
            root.querySelectorAll('webots-simulation').forEach((one) => one.remove());
        }""")
        until("all have ended", lambda: not self.simulations())

    def test_all_that_a_page_loads_has_40_kib_compressed_in_each_language(self):
        for language in LANGUAGES:
            with self.subTest(language):
                text = printed("A page").replace('id="robot"', f'id="robot" lang="{language}"')
                page = self.visit("page", text)
                page.tab.locator("[part=start]").click()
                expect(page.tab.locator(SHOWN)).to_be_visible()
                page.tab.locator("[part=leave]").click()
                until("it is gone", lambda: not self.simulations())
                parts = [url for url in page.asked if url.startswith("http://127.0.0.1")]
                parts = [url for url in parts if re.search(r"/embed\.js$|/assets/\w+\.(js|css)$", url)]
                self.assertGreater(len(parts), 5)
                sizes = {url: self.compressed(url) for url in parts}
                print(f"{language}: {sum(sizes.values())} bytes in {len(sizes)} files", file=sys.stderr)
                self.assertLessEqual(sum(sizes.values()), 40 * 1024, sizes)

    def compressed(self, url):
        """The size of what this URL answers, in bytes."""
        request = urllib.request.Request(url, headers={"Accept-Encoding": "gzip"})
        with urllib.request.urlopen(request, timeout=SOON) as answer:
            return len(answer.read())

    @unittest.skipUnless("QUIET_MACHINE" in os.environ, "it depends on the speed of the machine")
    def test_on_a_quiet_machine_it_is_drawn_within_100_ms(self):
        text = printed("A page").replace(
            '<script type="module" src',
            """<script>
              const look = () => {
                const shown = document.querySelector("webots-simulation")?.shadowRoot?.querySelector("#availability");
                if (shown?.offsetHeight) window.drawn = performance.now();
                else requestAnimationFrame(look);
              };
              look();
            </script>
            <script type="module" src""",
        )
        took = []
        for _ in range(5):
            page = self.visit("page", text)
            until("it is drawn", lambda page=page: page.tab.evaluate("window.drawn"))
            begin = """performance.getEntriesByType('resource')
                .find((one) => one.name.endsWith('/embed.js')).startTime"""
            took.append(page.tab.evaluate(f"window.drawn - {begin}"))
        print(f"drawn after {[round(one) for one in took]} ms", file=sys.stderr)
        self.assertLess(statistics.median(took), 100)

    def test_text_inside_is_for_where_the_element_does_not_run(self):
        text = printed("A page").replace("></webots-simulation>", ">Please enable JavaScript.</webots-simulation>")
        page = self.visit("text", text)
        expect(page.tab.locator("#availability.on")).to_be_visible()
        drawn = """() => {
            const text = document.createRange();
            text.selectNodeContents(document.querySelector('webots-simulation'));
            return text.getClientRects().length;
        }"""
        self.assertEqual(page.tab.evaluate(drawn), 0)
        without = self.visit("text", text, javascript=False)
        expect(without.tab.get_by_text("Please enable")).to_be_visible()
        without.complaints.clear()


class InLine(Embedding):
    key = "a secret of these tests"
    session = {"fleetKey": key, "loadThreshold": 1000, "port": free_ports(64) + 63}
    simulation = {"maxConnections": 1, "fleetKey": key}

    def test_a_page_waits_in_line_also_over_a_reload(self):
        text = printed("Two simulations")
        first = self.visit("race", text)
        for side in ("left", "right"):
            expect(first.tab.locator(f"#{side} {SHOWN}")).to_be_visible()
        page = self.visit("page", printed("A page"))
        tab = page.tab
        expect(tab.locator("#availability")).not_to_contain_text("Connecting")
        tab.get_by_role("button", name="Connect").click()
        expect(tab.locator("#notice-text")).to_have_text("All servers are busy.")
        expect(tab.locator("#step-session small")).to_contain_text("you are next")
        self.assertEqual(page.faults(), [])
        self.assertEqual(tab.evaluate("document.getElementById('robot').state"), "waiting")
        tab.reload()
        expect(tab.locator("#step-session small")).to_contain_text("you are next")
        first.tab.get_by_role("button", name="Give up").click()
        expect(tab.locator(SHOWN)).to_be_visible()
        # Its page is left, and it waits; the element on the other page is closed with it.
        tab.evaluate("document.getElementById('robot').remove()")
        first.tab.evaluate("document.getElementById('left').remove()")
        until("all is over", lambda: not self.simulations())

    @in_firefox
    def test_in_firefox_a_page_waits_in_line_also_over_a_reload(self):
        first = self.visit("race", printed("Two simulations"))
        for side in ("left", "right"):
            expect(first.tab.locator(f"#{side} {SHOWN}")).to_be_visible()
        tab, part = self.firefox(self.site.put("page", printed("A page")))
        until("it is known", lambda: tab.evaluate("document.getElementById('robot').state") == "idle")
        tab.evaluate("document.getElementById('robot').start()")
        note = f"{part('robot', '#step-session small')}?.textContent"
        until("it waits", lambda: "you are next" in (tab.evaluate(note) or ""))
        tab.reload()
        until("it waits again", lambda: "you are next" in (tab.evaluate(note) or ""))
        first.tab.get_by_role("button", name="Give up").click()
        until("it is shown", lambda: tab.evaluate(f"!!{part('robot', SHOWN)}"))
        tab.evaluate("document.getElementById('robot').remove()")
        first.tab.evaluate("document.getElementById('left').remove()")
        until("all is over", lambda: not self.simulations())


class Refused(Embedding):
    may_complain = True
    simulation = {"allowedOrigins": ["https://other.example.org"]}

    def test_a_site_that_is_not_listed_is_told_once_on_the_page_and_in_the_console(self):
        page = self.visit("page", printed("A page"))
        tab = page.tab
        expect(tab.locator("#availability.on")).to_be_visible()
        tab.get_by_role("button", name="Connect").click()
        expect(tab.locator("#problem-text")).to_have_text(
            "The simulation server starts nothing for pages of this site."
        )
        expect(tab.locator("#problem-advice")).to_contain_text("allowedOrigins")
        own = [one for one in page.complaints if "webots-simulation" in one]
        self.assertEqual(len(own), 1, page.complaints)
        self.assertIn(self.site.origin, own[0])
        expect(tab.locator("#told")).to_contain_text("It has ended: The simulation server starts nothing")

    @in_firefox
    def test_in_firefox_a_site_that_is_not_listed_is_told_once_on_the_page_and_in_the_console(self):
        tab, part = self.firefox(self.site.put("page", printed("A page")))
        until("it is known", lambda: tab.evaluate("document.getElementById('robot').state") == "idle")
        tab.evaluate("document.getElementById('robot').start()")
        problem = f"{part('robot', '#problem-text')}?.textContent"
        words = "The simulation server starts nothing for pages of this site."
        until("it is told", lambda: tab.evaluate(problem) == words)
        own = [one for one in tab.complaints if "webots-simulation" in one]
        self.assertEqual(len(own), 1, tab.complaints)
        self.assertIn(self.site.origin, own[0])


class InAFrame(Embedding):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        # The port of the site is known only now.
        cls.framed = cls.framing("framed")

    @classmethod
    def framing(cls, name, **config):
        """A session server that the site may frame."""
        servers = {"simulationServers": [cls.fleet.simulation.address], "loadRefresh": 0.2, "loadThreshold": 1000}
        named = {"port": free_ports(1), "frameAncestors": [cls.site.origin]}
        return cls.fleet.start("session-server", name, {**servers, **named, **config})

    def course(self, server, query=""):
        """The URL of a page with the printed frame, of this server."""
        text = f"<!DOCTYPE html><html lang='en'><title>Course</title><main><h1>Course</h1>{printed('A frame')}</main>"
        text = text.replace("https://simulations.example.org", server.url("").rstrip("/"))
        return self.site.put("course", text.replace("embed=1", f"embed=1{query}"))

    def attend(self, server, query=""):
        """The page, and its frame once it is there."""
        page = self.open(self.course(server, query))
        expect(page.tab.frame_locator("iframe").locator("#availability.on")).to_be_visible()
        return page, page.tab.frames[1]

    def test_only_a_site_that_is_listed_may_frame_the_viewer(self):
        self.may_complain = True
        text = f"<!DOCTYPE html><html lang='en'><title>Course</title><main>{printed('A frame')}</main>"
        refused = self.visit("course", text)
        until("the browser says why", lambda: any("frame-ancestors" in one for one in refused.complaints))
        page, frame = self.attend(self.framed)
        self.assertEqual(page.faults(), [])
        frame.get_by_role("button", name="Connect").click()
        expect(frame.locator(SHOWN)).to_be_visible()
        frame.get_by_role("button", name="Play", exact=True).click()
        expect(frame.locator("#mode")).to_have_text("real time")
        self.fills_the_screen(page, frame)
        (before,) = self.simulations()
        page.tab.reload()
        frame = page.tab.frame_locator("iframe")
        expect(frame.locator("#mode")).to_have_text("real time")
        (after,) = self.simulations()
        self.assertEqual((before["id"], before["pid"]), (after["id"], after["pid"]))
        frame.get_by_role("button", name="Disconnect").click()
        until("it is gone", lambda: not self.simulations())
        self.assertEqual(page.complaints, [])

    @in_firefox
    def test_in_firefox_the_frame_runs_a_simulation_also_over_a_reload(self):
        tab, part = self.firefox(self.course(self.framed))

        def shows(selector):
            return tab.evaluate(f"!!{part('simulation', selector)}", tab.frame())

        until("it is available", lambda: shows("#availability.on"))
        tab.evaluate(f"{part('simulation', '[part=start]')}.click()", tab.frame())
        until("it is shown", lambda: shows(SHOWN))
        (before,) = self.simulations()
        tab.reload()
        until("it is shown again", lambda: shows(SHOWN))
        (after,) = self.simulations()
        self.assertEqual((before["id"], before["pid"]), (after["id"], after["pid"]))
        tab.evaluate(f"{part('simulation', '[part=leave]')}.click()", tab.frame())
        until("it is gone", lambda: not self.simulations())

    def test_the_frame_asks_for_a_name_and_starts_nothing_without_where_one_is_required(self):
        page, frame = self.attend(self.framing("naming", askName="required"), "&amp;start=1")
        name = frame.get_by_label("Your name")
        name.fill(" ")
        frame.locator("[part=start]").click()
        expect(name).to_be_focused()
        self.assertFalse(name.evaluate("(field) => field.validity.valid"))
        self.assertEqual(self.simulations(), [])
        name.fill("Anna")
        frame.locator("[part=start]").click()
        expect(frame.locator(SHOWN)).to_be_visible()
        self.assertIn('calls itself "Anna"', self.fleet.simulation.log.read_text())
        frame.locator("[part=leave]").click()
        until("it is gone", lambda: not self.simulations())
        self.in_order(page, frame)


if __name__ == "__main__":
    unittest.main()
