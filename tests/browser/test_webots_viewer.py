"""Webots' own viewer, served from the installation of Webots; a stand-in, so that the test needs no Webots."""

import pathlib
import re
import shutil
import tempfile
import unittest

from case import BrowserTest
from door import COOKIE, OneDoor
from fleet import BIN, WORLD, until
from playwright.sync_api import expect

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
    socket.onopen = () => socket.send(broadcast ? 'w3d;broadcast' : 'w3d');
    socket.onmessage = async ({ data }) => {
      if (data === 'scene load completed') {
        const file = await fetch(`${server.replace('ws', 'http')}worlds/textures/wood.png`);
        this.textContent += ` ${data}, ${await file.text()}`;
        socket.send('real-time:-1');
      } else if (data.startsWith('application/json:'))
        this.title = data;
    };
  }
}
customElements.define('webots-view', WebotsView);
"""


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
        page = self.open(self.fleet.session.url("viewer"))
        sent = self.sent_over_streams(page)
        expect(page.tab.locator("#availability")).to_contain_text("Available")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        view = page.tab.frame_locator("#stage iframe").locator("webots-view")
        expect(view).to_contain_text("connected to ws://127.0.0.1:")
        expect(view).to_contain_text("/wwi/wren.data undefined null compiled")
        expect(view).to_have_css("font-size", "20px")
        until("it asks for the scene", lambda: sent)
        self.assertEqual([text for text in sent if text.startswith("w3d")], ["w3d"])


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
        page = self.visit(self.fleet.url(f"viewer?url={WORLD.format('playground')}"))
        expect(page.tab.locator("#availability.on")).to_be_visible()
        page.tab.get_by_label("Shown by").select_option("webots")
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        view = page.tab.frame_locator("#stage iframe").locator("webots-view")
        expect(view).to_contain_text(f"connected to wss://{self.fleet.host}/127.0.0.")
        expect(view).to_contain_text("scene load completed, a picture")
        moves = re.compile("^application/json:")
        expect(view).to_have_attribute("title", moves)
        server = page.tab.locator("[data-step=server] small").inner_text().replace("wss:", "https:")
        teacher = self.visit("about:blank")
        teacher.sign_in(server, "secret")
        teacher.tab.goto(teacher.tab.get_by_role("link", name="Watch").evaluate("link => link.href"))
        watched = teacher.tab.frame_locator("#stage iframe").locator("webots-view")
        expect(watched).to_contain_text(f"connected to {server.replace('https:', 'wss:')}/stream/")
        expect(watched).to_have_attribute("title", moves)
        expect(page.tab.locator("#watched")).to_be_visible()


if __name__ == "__main__":
    unittest.main()
