"""A page that inserts texts of a simulation server as HTML, like Webots' page, and a world whose name is a script."""

import json
import unittest

from case import BrowserTest

IMAGE = "%3Cimg%20src=x%20onerror=%22window.injected=true%22%3E"
URLS = [
    f"https://github.com/demo/worlds/blob/main/worlds/{IMAGE}.wbt",
    f"https://github.com/demo/worlds/blob/{IMAGE}/worlds/playground.wbt",
    f"https://github.com/demo/{IMAGE}/blob/main/worlds/playground.wbt",
    f"https://github.com/{IMAGE}/worlds/blob/main/worlds/playground.wbt",
    f"https://github.com/demo/worlds/blob/main/worlds/{IMAGE}.txt",
]
# Resolves with the texts once the connection is closed and an image would have had the time to fail.
PAGE = """([server, start]) => new Promise((resolve) => {
  document.body.innerHTML = '<p id="text"></p>';
  const texts = [];
  const socket = new WebSocket(`${server}/client`);
  socket.onopen = () => socket.send(start);
  socket.onmessage = ({ data }) => {
    texts.push(data);
    if (data.startsWith('loading:'))
      document.getElementById('text').innerHTML += data.slice('loading:'.length);
  };
  socket.onclose = () => {
    const control = new Image();
    control.onerror = () => setTimeout(() => resolve(texts), 100);
    control.src = 'data:,';
  };
})"""


class ScriptInjection(BrowserTest):
    def test_no_text_of_a_simulation_server_runs_as_a_script(self):
        for url in URLS:
            with self.subTest(url=url):
                page = self.browser.page()
                self.addCleanup(page.close)
                start = json.dumps({"start": {"url": url}})
                texts = page.tab.evaluate(PAGE, [f"ws://{self.fleet.simulation.address}", start])
                self.assertTrue(any("\u2039img" in text for text in texts), texts)
                self.assertEqual(page.tab.locator("#text img").count(), 0, texts)
                self.assertIsNone(page.tab.evaluate("window.injected ?? null"), texts)


if __name__ == "__main__":
    unittest.main()
