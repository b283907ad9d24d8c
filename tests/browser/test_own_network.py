"""A page streams from a simulation in its own network, which needs pasta and an unprivileged user."""

import os
import pathlib
import shutil
import unittest

from case import BrowserTest, picture
from demo import Demo
from fleet import BIN, until
from playwright.sync_api import expect
from test_demo import clock

NOBODY = 65534


def shortcoming():
    """The reason why this machine can't run the test, or None."""
    if not shutil.which("pasta"):
        return "pasta is not there: apt install passt"
    tun = pathlib.Path("/dev/net/tun")
    if not tun.exists() or tun.stat().st_mode & 0o006 != 0o006:
        return "an ordinary user can't open /dev/net/tun here"
    closed = [folder for folder in [BIN, *BIN.parents] if folder.stat().st_mode & 1 == 0]
    if os.getuid() == 0 and closed:
        return f"others can't run what is in {closed[0]}"
    return None


@unittest.skipIf(shortcoming(), shortcoming())
class OwnNetwork(BrowserTest):
    host = "localhost"

    @classmethod
    def make_fleet(cls):
        user = NOBODY if os.getuid() == 0 else None
        return Demo(simulation={"isolation": "sandbox", "sandbox": {"network": "own"}}, user=user)

    def test_a_page_streams(self):
        self.assertIn("network: own, with the internet", self.fleet.started)
        page = self.open(f"http://{self.fleet.session}/viewer")
        page.tab.get_by_role("button", name="Playground").click()
        page.tab.get_by_role("button", name="Connect", exact=True).click()
        expect(page.tab.locator("[data-step=simulation].done")).to_be_visible()
        first = picture(page)
        page.tab.get_by_role("button", name="Play", exact=True).click()
        until("half a second has passed", lambda: clock(page) > 500)
        self.assertNotEqual(picture(page), first, "nothing has moved")
        self.assertEqual(page.faults(), [])
        page.tab.get_by_role("button", name="Disconnect").click()
