"""Webots' own viewer, taken from where Webots is installed: a stand-in for it, for no Webots is needed here."""

import pathlib
import tempfile
import unittest

from playwright.sync_api import expect

from case import BrowserTest

# As the real one does, it names its style sheet by another site and makes a script in the page.
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
  connect(server) {
    localStorage.setItem('theme', 'dark');
    this.textContent = `${greeting} ${server} ${Module.locateFile('wren.data', '')} ${window.ran} ${window.origin}`;
  }
}
customElements.define('webots-view', WebotsView);
"""


class WebotsViewer(BrowserTest):
    @classmethod
    def setUpClass(cls):
        home = pathlib.Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        folder = home / "resources/web/wwi"
        (folder / "css").mkdir(parents=True)
        (folder / "WebotsView.js").write_text(COMPONENT)
        (folder / "part.js").write_text("export const greeting = 'connected to';\n")
        (folder / "css/wwi.css").write_text("webots-view { font-size: 20px; }\n")
        cls.simulation = {"webotsHome": str(home)}
        super().setUpClass()

    def test_it_is_loaded_from_the_simulation_server_alone(self):
        page = self.open(self.fleet.session.url("viewer"))
        expect(page.tab.locator("#light")).to_contain_text("Available")
        page.tab.get_by_label("Shown by").select_option("webots")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        view = page.tab.frame_locator("#stage iframe").locator("webots-view")
        expect(view).to_contain_text("connected to ws://127.0.0.1:")
        expect(view).to_contain_text("/wwi/wren.data undefined null")
        expect(view).to_have_css("font-size", "20px")

    def test_a_scene_of_the_demonstration_is_shown_by_the_small_viewer(self):
        page, _ = self.start_world()
        expect(page.tab.locator("#view")).to_be_visible()


if __name__ == "__main__":
    unittest.main()
