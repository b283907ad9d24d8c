"""Chromium, driven by Playwright, and the checks of every page."""

import os
import tempfile
import urllib.parse

from axe_playwright_python.sync_playwright import Axe
from fleet import SOON
from playwright.sync_api import sync_playwright

# Debian's headless build of Chromium takes half of the processor time.
SHELL = "/usr/bin/chromium-headless-shell"
CHROMIUM = os.environ.get("CHROMIUM") or (SHELL if os.path.exists(SHELL) else "/usr/bin/chromium")
# The browser itself must not call home either. It draws scenes with software rendering, and pages without, which would
# take twice as much processor time.
SWITCHES = [
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--disable-features=Translate,OptimizationHints,MediaRouter",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
]
# A warning about its own speed is not an error of the page.
OWN_SPEED = "GL Driver Message (OpenGL, Performance"


class Browser:
    """A Chromium with its own profile, and further switches; a context manager."""

    def __init__(self, switches=()):
        self.switches = [*SWITCHES, *switches]

    def __enter__(self):
        self.profile = tempfile.TemporaryDirectory(prefix="chromium-")
        self.playwright = sync_playwright().start()
        self.context = None
        self.chromium = self.playwright.chromium.launch(executable_path=CHROMIUM, args=self.switches)
        return self

    def __exit__(self, *_):
        self.chromium.close()
        self.playwright.stop()
        self.profile.cleanup()

    def page(self, scheme="light", width=1280, height=900, javascript=True, **options):
        context = self.chromium.new_context(
            color_scheme=scheme, viewport={"width": width, "height": height}, java_script_enabled=javascript, **options
        )
        context.set_default_timeout(1000 * SOON)
        return Page(context)


class Page:
    """A tab that records requested URLs and messages of the console."""

    def __init__(self, context):
        self.context = context
        self.tab = context.new_page()
        self.asked, self.complaints = [], []
        self.tab.on("request", lambda request: self.asked.append(request.url))
        self.tab.on("websocket", lambda socket: self.asked.append(socket.url))
        self.tab.on("console", self._console)
        self.tab.on("pageerror", lambda error: self.complaints.append(str(error)))

    def _console(self, message):
        if message.type in ("error", "warning") and OWN_SPEED not in message.text:
            self.complaints.append(f"{message.type}: {message.text}")

    def sign_in(self, server, password, name="teacher"):
        """Signs in at a server as an administrator, and returns to the page that follows."""
        self.tab.goto(f"{server}/sign-in")
        self.tab.get_by_label("Your name").fill(name)
        self.tab.get_by_label("Password").fill(password)
        self.tab.get_by_role("button", name="Sign in").click()
        self.tab.wait_for_url(lambda url: "sign-in" not in url)

    def from_address(self, address):
        """From now on its requests seem to be forwarded by a web server, from this address."""
        self.context.set_extra_http_headers({"X-Forwarded-For": address})

    def hosts(self):
        parts = (urllib.parse.urlsplit(url) for url in self.asked)
        return {part.hostname for part in parts if part.scheme not in ("data", "blob", "about")}

    def faults(self, frame=None):
        """All violations that axe-core finds, in the page or in a frame of it."""
        # Console messages of axe-core itself are not errors of the page.
        complaints = list(self.complaints)
        axe, page = Axe(), frame or self.tab
        if not page.evaluate("'axe' in window"):
            page.evaluate(axe.axe_script)
        violations = page.evaluate("axe.run({ resultTypes: ['violations'] })")["violations"]
        self.complaints[:] = complaints
        return [
            f"{one['id']}: {node['html'][:200]} {node['failureSummary']}" for one in violations for node in one["nodes"]
        ]

    def overflow(self, frame=None):
        """The number of pixels by which the page, or a frame of it, is wider than its window."""
        return (frame or self.tab).evaluate(
            "document.documentElement.scrollWidth - document.documentElement.clientWidth"
        )

    def look(self, scheme, width):
        """Changes the colour scheme and the width of the window."""
        self.tab.emulate_media(color_scheme=scheme)
        self.tab.set_viewport_size({"width": width, "height": 900})

    def close(self):
        self.context.close()
