"""A visit through a web server, from the first click to the end: through_web_server.py URL [--own-origin]

URL is that of the viewer. The session server behind it offers a world called Arm. The certificate is not checked here,
but in the tests of the web servers. --own-origin says that the web server sandboxes Webots' files, so that they have an
opaque origin.
"""

import re
import sys
import urllib.parse

from browser import Browser, Page
from fleet import SOON, until
from playwright.sync_api import expect


def cannot_read_what_is_the_administrators(context, webots):
    """Asserts that a simulation's page can't read the output that the administrator's password protects."""
    tab = context.new_page()
    tab.goto(webots + "nothing.html")
    assert tab.evaluate("window.origin") == "null"
    port = int(webots.rstrip("/").rsplit("/", 1)[1])
    for server in range(port - 3, port):
        read = f"fetch('/{server}/output?id=1', {{credentials: 'include'}}).then(() => 'read', () => 'blocked')"
        assert tab.evaluate(read) == "blocked"
    tab.close()


def visit(browser, url, own_origin):
    context = browser.chromium.new_context(ignore_https_errors=True)
    context.set_default_timeout(1000 * SOON)
    page = Page(context)
    tab = page.tab
    tab.goto(url)
    expect(tab.locator("#availability")).to_contain_text("Available")
    tab.get_by_role("button", name="Arm").click()
    tab.get_by_role("button", name="Connect", exact=True).click()
    expect(tab.locator("[data-step=simulation].done")).to_be_visible()
    assert "wss://" in tab.locator("[data-step=server] small").inner_text()
    tab.get_by_role("button", name="Play", exact=True).click()
    until("the simulation runs", lambda: tab.locator("#clock").inner_text() not in ("", "0:00.000"))
    if own_origin:
        stream = next(one for one in page.asked if re.search(r"^wss://[^/]+/\d+/$", one))
        cannot_read_what_is_the_administrators(context, stream.replace("wss:", "https:"))
    tab.get_by_role("button", name="Disconnect").click()
    expect(tab.locator("#stage")).to_contain_text("it has ended")
    assert not page.complaints, page.complaints
    open_text = [one for one in page.asked if urllib.parse.urlsplit(one).scheme in ("http", "ws")]
    assert not open_text, open_text
    page.close()


expect.set_options(timeout=1000 * SOON)
with Browser() as visitor:
    visit(visitor, sys.argv[1], "--own-origin" in sys.argv)
