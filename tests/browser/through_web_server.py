"""A visitor's way through a web server, from the first click to the end: through_web_server.py https://HOST/viewer

The session server behind it offers a world called Arm. The certificate is not looked at: the tests of the web servers
do that.
"""

import sys
import urllib.parse

from playwright.sync_api import expect

from browser import Browser, Page
from fleet import SOON, until


def visit(browser, url):
    context = browser.chromium.new_context(ignore_https_errors=True)
    context.set_default_timeout(1000 * SOON)
    page = Page(context)
    tab = page.tab
    tab.goto(url)
    expect(tab.locator("#light")).to_contain_text("Available")
    tab.get_by_role("button", name="Arm").click()
    tab.get_by_role("button", name="Connect", exact=True).click()
    expect(tab.locator("[data-step=simulation].done")).to_be_visible()
    assert "wss://" in tab.locator("[data-step=server] small").inner_text()
    tab.get_by_role("button", name="Play", exact=True).click()
    until("the simulation runs", lambda: tab.locator("#clock").inner_text() not in ("", "0:00.000"))
    tab.get_by_role("button", name="Disconnect").click()
    expect(tab.locator("#stage")).to_contain_text("it has ended")
    assert not page.complaints, page.complaints
    open_text = [one for one in page.asked if urllib.parse.urlsplit(one).scheme in ("http", "ws")]
    assert not open_text, open_text
    page.close()


expect.set_options(timeout=1000 * SOON)
with Browser() as visitor:
    visit(visitor, sys.argv[1])
