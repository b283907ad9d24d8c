"""Webots' own viewer, served from the installation of Webots; a stand-in, so that the test needs no Webots."""

import pathlib
import re
import shutil
import tempfile
import unittest

from case import BrowserTest
from door import COOKIE, OneDoor
from fleet import BIN, WORLD, free_ports, until
from playwright.sync_api import expect
from site_of_others import FLEET, Site, printed

# Like the real one, it links a style sheet of another site, adds a script to the page, and compiles a function.
COMPONENT = """
import { greeting } from './part.js';
class WebotsView extends HTMLElement {
  connectedCallback() {
    const style = document.createElement('link');
    style.rel = 'stylesheet';
    style.href = 'https://cyberbotics.com/wwi/R2025a/css/wwi.css';
    document.head.appendChild(style);
    const script = document.createElement('script');
    script.textContent = 'window.ran = true;';
    document.head.appendChild(script);
  }
  connect(server, mode, broadcast) {
    localStorage.setItem('theme', 'dark');
    this.textContent = `${greeting} ${server} ${Module.locateFile('wren.data', '')} ${window.ran} ${window.origin}`;
    this.textContent += new Function('return " compiled"')();
    this.stream(`${server}/`, broadcast);
  }
  // As the real one does it: texts over the stream, files from where the stream is.
  stream(server, broadcast) {
    const socket = new WebSocket(server);
    this.sendMessage = (text) => socket.readyState === 1 && socket.send(text);
    socket.onopen = () => socket.send(broadcast ? 'w3d;broadcast' : 'w3d');
    socket.onmessage = async ({ data }) => {
      if (data === 'scene load completed') {
        const file = await fetch(`${server.replace('ws', 'http')}worlds/textures/wood.png`);
        this.textContent += ` ${data}, ${await file.text()}`;
        this.onready();
      } else if (data.startsWith('application/json:'))
        this.title = data;
    };
  }
}
customElements.define('webots-view', WebotsView);
"""
MOVES = re.compile("^application/json:")


def installed(test):
    """The keys of a simulation server that serves Webots' viewer."""
    home = pathlib.Path(test.enterClassContext(tempfile.TemporaryDirectory()))
    folder = home / "resources/web/wwi"
    (folder / "css").mkdir(parents=True)
    (folder / "WebotsView.js").write_text(COMPONENT)
    (folder / "part.js").write_text("export const greeting = 'connected to';\n")
    (folder / "css/wwi.css").write_text("webots-view { font-size: 20px; }\n")
    return {"webotsHome": str(home)}


class WebotsViewer(BrowserTest):
    @classmethod
    def setUpClass(cls):
        keys = installed(cls)
        # The demo simulator, but not by its name.
        webots = shutil.copy(BIN / "demo-simulator", f"{keys['webotsHome']}/webots")
        cls.simulation = {**keys, "webots": webots}
        super().setUpClass()

    def test_it_is_loaded_from_the_simulation_server_alone_and_nothing_else_asks_for_the_scene(self):
        page = self.open("about:blank")
        sent = self.sent_over_streams(page)
        page.tab.goto(self.fleet.session.url(f"viewer?url={WORLD.format('playground')}&start=1&play=1"))
        view = page.tab.frame_locator("#stage iframe").locator("webots-view")
        expect(view).to_contain_text("connected to ws://127.0.0.1:")
        expect(view).to_contain_text("/wwi/wren.data undefined null compiled")
        expect(view).to_have_css("font-size", "20px")
        expect(view).to_contain_text("scene load completed")
        # What the page wants before the viewer has the scene is not lost.
        expect(view).to_have_attribute("title", MOVES)
        self.assertEqual(sent, ["w3d", "real-time:-1"])

    def test_in_a_page_of_another_site_it_is_shown_where_the_site_may_frame_it(self):
        site = self.enterContext(Site(self.fleet))
        self.may_complain, self.elsewhere = True, {"localhost"}
        text = printed("A page").replace('id="robot"', 'id="robot" autostart viewer="webots"')
        refused = self.open(site.put("refused", text))
        expect(refused.tab.locator("#problem-text")).to_contain_text("frameAncestors")
        until("the console has it", lambda: any("frameAncestors" in one for one in refused.complaints))
        refused.tab.close()
        servers = {"simulationServers": [self.fleet.simulation.address], "loadRefresh": 0.2, "loadThreshold": 1000}
        named = {"port": free_ports(1), "frameAncestors": [site.origin]}
        framing = self.fleet.start("session-server", "framing", {**servers, **named})
        play = """<script type="module">
          await customElements.whenDefined('webots-simulation');
          document.getElementById('robot').play();
        </script>"""
        allowed = self.open("about:blank")
        sent = self.sent_over_streams(allowed)
        allowed.tab.goto(site.put("allowed", text.replace(FLEET, framing.url("").rstrip("/")) + play))
        view = allowed.tab.frame_locator("webots-simulation iframe").locator("webots-view")
        expect(view).to_contain_text("scene load completed")
        expect(view).to_have_attribute("title", MOVES)
        self.assertEqual(sent, ["w3d", "real-time:-1"])


class BehindTheDoor(BrowserTest):
    """The same with relayed streams, on several machines behind one web server where visitors sign in."""

    host = "localhost"

    @classmethod
    def make_fleet(cls):
        return OneDoor(places=2, simulation={**installed(cls), "adminPassword": "secret"})

    def visit(self, url, **options):
        page = self.open("about:blank", ignore_https_errors=True, **options)
        page.context.add_cookies([{"name": COOKIE, "value": "anna", "url": self.fleet.url("")}])
        page.tab.goto(url)
        return page

    def test_a_scene_of_the_demonstration_is_shown_by_the_small_viewer(self):
        page = self.visit(self.fleet.url(f"viewer?url={WORLD.format('playground')}&start=1"))
        expect(page.tab.locator("#view")).to_be_visible()
        page.tab.get_by_role("button", name="Disconnect").click()
        expect(page.tab.locator("#stage")).to_contain_text("it has ended")

    def test_it_streams_through_the_door_and_an_administrator_watches_with_it(self):
        page = self.visit(self.fleet.url(f"viewer?url={WORLD.format('playground')}&play=1"))
        expect(page.tab.locator("#availability.on")).to_be_visible()
        page.tab.get_by_label("Shown by").select_option("webots")
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        view = page.tab.frame_locator("#stage iframe").locator("webots-view")
        expect(view).to_contain_text(f"connected to wss://{self.fleet.host}/127.0.0.")
        expect(view).to_contain_text("scene load completed, a picture")
        expect(view).to_have_attribute("title", MOVES)
        server = page.tab.locator("[data-step=server] small").inner_text().replace("wss:", "https:")
        teacher = self.visit("about:blank")
        teacher.sign_in(server, "secret")
        teacher.tab.goto(teacher.tab.get_by_role("link", name="Watch").evaluate("link => link.href"))
        watched = teacher.tab.frame_locator("#stage iframe").locator("webots-view")
        expect(watched).to_contain_text(f"connected to {server.replace('https:', 'wss:')}/stream/")
        expect(watched).to_have_attribute("title", MOVES)
        expect(page.tab.locator("#watched")).to_be_visible()


if __name__ == "__main__":
    unittest.main()
