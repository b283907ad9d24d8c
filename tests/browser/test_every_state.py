"""Every state of a visit, and the pages of who watches and of Webots' own viewer: in all languages, in both schemes, on
a phone and enlarged."""

import itertools
import json
import re
import unittest

from case import Administered
from fleet import WORLD, free_ports, until
from playwright.sync_api import expect
from site_of_others import Site, printed
from test_webots_viewer import installed
from websockets.sync.client import connect

LANGUAGES = ["en", "de", "fr", "es", "zh", "ja"]
# A phone, a page at 200 %, and a phone at 200 %.
SIZES = [(390, 800), (640, 450), (195, 400)]
# A state has another look in each language, and all of them over all languages.
LOOKS = list(itertools.product(["light", "dark"], SIZES))

# The simulator of which the page's simulation server tells; `Servers` plays it.
SIMULATOR = "ws://127.0.0.1:9"
SCENE = 'model:<X3D><head/><Scene><WorldInfo title="A robot"/><Shape><Box size="1 1 1"/></Shape></Scene></X3D>'
# What servers do instead of sending a text: close the connection; choose a server that refuses pages of the site.
CLOSE, STRICT = object(), object()


def failure(code, blame="fleet", retry="later", start="loading: Error:", **more):
    sentence = "a sentence of the server about a_file_of_the_project_with_a_long_name.wbt"
    told = {"code": code, "blame": blame, "retry": retry, "message": sentence, **more}
    return [f"reason: {json.dumps(told)}", f"{start} {sentence}"]


def refused(*arguments):
    return failure(*arguments, start="Error:")


def progress(step, text, percent):
    return [f"progress: {json.dumps({'step': step, 'text': text, 'percent': percent})}", f"loading: {text}"]


FETCHES = progress("fetch", "receiving objects", 40)
LAUNCHES = [*FETCHES, *progress("launch", "starting Webots", 80), "shutdownTimeout: 7260"]
RUNS = [*LAUNCHES, f"webots:{SIMULATOR}", "watched: 1", "idle: 90", "realTime: 0.4"]
SHOWS = ["loading: Loading nodes:70", SCENE, "stderr:a warning"]
RETURNS = [*RUNS, "absence: 20", "resume: token"]
OUTPUT = "Traceback: " + 20 * "a_long_line_"
# What a start gets: from the session server (None: the address of a simulation server), from that, and from the
# simulator; how much time passes once the connection is lost, in milliseconds; and what is seen.
STATES = {
    "waits for any server": (refused("no-server-available"), [], [], 0, "[data-is=waiting] #notice"),
    "waits for its share": (refused("share-used"), [], [], 0, "[data-is=waiting] #notice"),
    "waits in line": (["ticket:a", "queue:3", "estimate:600"], [], [], 0, "[data-is=asking] #notice"),
    "waits at a server": (None, ["queue: 2"], [], 0, "[data-is=connecting] #step-place.doing"),
    "gets another server": (None, failure("draining", "server", "elsewhere"), [], 0, "[data-is=redirected]"),
    "fetches": (None, FETCHES, [], 0, "[data-is=starting] #step-checkout.doing"),
    "launches": (None, LAUNCHES, [], 0, "[data-is=starting] #left"),
    "loads": (None, RUNS, SHOWS[:1], 0, "[data-is=running] #step-simulation.doing"),
    "runs": (None, RUNS, SHOWS, 0, "[data-is=running] #step-simulation.done"),
    "is lost while it starts": (None, [*FETCHES, *RETURNS[-2:], CLOSE], [], 3000, "[data-is=lost] #notice"),
    "is lost": (None, [*RETURNS, CLOSE], SHOWS, 3000, "[data-is=lost] #notice"),
    "is refused": (refused("invalid-world", "user", "no"), [], [], 0, "[data-is=ended] #problem"),
    "is refused without a reason": (["Error: a sentence"], [], [], 0, "[data-is=ended] #problem"),
    "fails": (None, [*FETCHES, *failure("world-not-found", "user", "no")], [], 0, "#step-checkout.failed"),
    "breaks": (None, [*RUNS, CLOSE], SHOWS, 0, "[data-is=ended] #problem"),
    "has no stream": (None, RUNS, [CLOSE], 0, "[data-is=ended] #problem"),
    "has no scene": (None, RUNS, ["model:<X3D>"], 0, "[data-is=ended] #problem"),
    "crashes": (None, [*RUNS, *failure("crashed", "project", "here", output=OUTPUT)], SHOWS, 0, "#problem-output"),
    "was away": (None, [*RETURNS, CLOSE], SHOWS, 60_000, "[data-is=ended] #problem"),
    "is of a site that is refused": ([STRICT], [], [], 0, "[data-is=ended] #problem"),
    "has lost the session server": ([CLOSE], [], [], 0, "[data-is=ended] #problem"),
}


class Servers:
    """Plays the servers and the simulator for a page."""

    def __init__(self, page, fleet):
        self.fleet, self.session, self.state = fleet, None, None
        page.tab.route_web_socket(re.compile(r"/session\?"), self._open_session)
        client = f"ws://{fleet.simulation.address}/client"
        page.tab.route_web_socket(client, lambda socket: self._serve(socket, '"start"', 1))
        page.tab.route_web_socket(f"{SIMULATOR}/", lambda socket: self._serve(socket, "", 2))

    def _open_session(self, socket):
        self.session = socket
        socket.send("1")
        self._serve(socket, '"url"', 0)

    def _serve(self, socket, request, number):
        """Answers texts with this in them as the state says. A client that returns gets no answer."""

        def answer(text):
            if request not in text:
                return
            texts = self.state[number]
            for one in [f"ws://{self.fleet.simulation.address}"] if texts is None else texts:
                if one is CLOSE:
                    socket.close(code=4000)
                elif one is STRICT:
                    socket.send(f"ws://{self.fleet.strict.address}")
                else:
                    socket.send(one)

        socket.on_message(answer)


class EveryState(Administered):
    elsewhere = frozenset({"localhost"})

    @classmethod
    def setUpClass(cls):
        # No viewer comes to the simulation that is watched: the test plays its stream.
        cls.simulation = {**installed(cls), "adminPassword": cls.password, "timing": {"arrival": 0}}
        super().setUpClass()
        cls.site = cls.enterClassContext(Site(cls.fleet))
        other = cls.fleet.other
        other.stop()
        strict = {**other.config, "allowedOrigins": ["https://other.example.org"]}
        cls.fleet.strict = cls.fleet.start("simulation-server", "strict", strict)
        server = {"simulationServers": [cls.fleet.simulation.address], "loadRefresh": 0.2, "loadThreshold": 1000}
        framed = {"port": free_ports(1), "frameAncestors": [cls.site.origin], **server}
        cls.framed = cls.fleet.start("session-server", "framed", framed)

    def in_order(self, page, look, frame=None):
        scheme, (width, height) = look
        page.tab.emulate_media(color_scheme=scheme)
        page.tab.set_viewport_size({"width": width, "height": height})
        self.assertEqual(page.faults(frame), [])
        self.assertLessEqual(page.overflow(frame), 0, "pixels too wide")

    def places(self, language):
        """The URLs of the pages in which a visit is shown in this language."""
        element = printed("A page").replace('id="robot"', f'id="robot" lang="{language}"')
        # Its own script writes what it is told, however long.
        element = element.split('<script type="module">')[0]
        frame = printed("A frame").replace("https://simulations.example.org", self.framed.url("").rstrip("/"))
        frame = frame.replace("embed=1", f"embed=1&amp;lang={language}")
        course = f"<!DOCTYPE html><html lang='en'><title>Course</title><main><h1>Course</h1>{frame}</main>"
        viewer = self.fleet.session.url(f"viewer?lang={language}&url={WORLD.format('playground')}")
        return [self.site.put("page", element), viewer, self.site.put("course", course)]

    def test_a_visit_is_in_order_in_every_state(self):
        for number, language in enumerate(LANGUAGES):
            for place, url in enumerate(self.places(language)):
                with self.subTest(url, language=language):
                    page = self.open("about:blank")
                    page.tab.clock.install()
                    servers = Servers(page, self.fleet)
                    page.tab.goto(url)
                    if place == 2:
                        expect(page.tab.frame_locator("iframe").locator("#availability.on")).to_be_visible()
                    frame = page.tab.frames[-1]
                    expect(frame.locator("#availability.on")).to_be_visible()
                    self.in_order(page, LOOKS[number], frame)
                    servers.session.send("announcement: The servers are switched off at noon.")
                    servers.session.send("0")
                    expect(frame.locator("#availability.off")).to_be_visible()
                    # A third of the states in each place: in each language all of them, and each in all places.
                    for turn, name in list(enumerate(STATES))[(number + place) % 3 :: 3]:
                        with self.subTest(name):
                            self.goes_to(page, servers, frame, name)
                            self.in_order(page, LOOKS[(number + turn) % len(LOOKS)], frame)
                    self.keeps_to_the_rules(page)
                    page.close()

    def goes_to(self, page, servers, frame, name):
        *servers.state, passes, seen = STATES[name]
        frame.evaluate("document.querySelector('webots-simulation').start()")
        if passes:
            expect(frame.locator("[data-is=lost]")).to_be_attached()
            page.tab.clock.fast_forward(passes)
        expect(frame.locator(seen)).to_be_visible()
        if STRICT in (servers.state[0] or []):
            until("the console says why", lambda: any("webots-simulation:" in one for one in page.complaints))
            page.complaints.clear()

    def test_who_watches_sees_pages_in_order(self):
        # It answers pings, however long the test takes.
        client = self.enterContext(connect(f"ws://{self.fleet.simulation.address}/client", max_queue=None))
        client.send(json.dumps({"start": {"url": WORLD.format("playground")}}))
        server = self.fleet.simulation.url("").rstrip("/")
        until("it is ready", lambda: [one["stage"] for one in self.simulations(self.fleet.simulation)] == ["idle"])
        (watched,) = self.simulations(self.fleet.simulation)
        page = self.open("about:blank")
        streams = []

        def play(socket):
            streams.append(socket)
            socket.on_message(lambda _: socket.send(SCENE))

        page.tab.route_web_socket(re.compile("/stream/"), play)
        page.sign_in(server, self.password)
        state = page.tab.locator("#state")
        for number, language in enumerate(LANGUAGES):
            with self.subTest(language):
                url = f"{server}/watch?id={watched['id']}&lang={language}"
                page.tab.goto(url)
                frame = page.tab.frame_locator("#stage iframe")
                expect(frame.locator("webots-view")).to_contain_text("connected")
                self.in_order(page, LOOKS[number])
                page.tab.goto(f"{url}&viewer=small")
                expect(page.tab.locator("#stage button").last).to_be_enabled()
                self.in_order(page, LOOKS[(number + 1) % len(LOOKS)])
                before = state.inner_text()
                streams[-1].close()
                expect(state).not_to_have_text(before)
                self.in_order(page, LOOKS[(number + 2) % len(LOOKS)])
                page.tab.goto(f"{server}/webots-viewer#lang={language}")
                page.tab.reload()
                expect(page.tab.locator("#problem")).not_to_be_empty()
                self.in_order(page, LOOKS[(number + 3) % len(LOOKS)])


if __name__ == "__main__":
    unittest.main()
