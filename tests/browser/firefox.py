"""Firefox as the system has it, driven by WebDriver BiDi: Playwright drives only a build of its own."""

import contextlib
import json
import os
import pathlib
import shutil
import subprocess
import tempfile

from fleet import SOON, until
from websockets.sync.client import connect

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
# Without a display it has no WebGL.
XVFB = shutil.which("Xvfb")
MISSING = "" if FIREFOX and XVFB else "apt install firefox-esr xvfb"
# The browser itself must not call home, nor show pages of its own.
SETTINGS = {
    "app.normandy.enabled": False,
    "app.update.disabledForTesting": True,
    "browser.aboutwelcome.enabled": False,
    "browser.safebrowsing.update.enabled": False,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "extensions.getAddons.cache.enabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "toolkit.telemetry.server": "",
}


@contextlib.contextmanager
def process(command, **options):
    """A program, which ends with the context."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, **options) as running:
        try:
            yield running
        finally:
            running.terminate()


@contextlib.contextmanager
def display():
    """A display without a screen; its name."""
    number, told = os.pipe()
    with os.fdopen(number) as number:
        command = [XVFB, "-displayfd", str(told), "-screen", "0", "1280x900x24", "-nolisten", "tcp"]
        with process(command, pass_fds=[told], stderr=subprocess.DEVNULL):
            os.close(told)
            yield f":{number.readline().strip()}"


class Firefox:
    """A Firefox with its own profile and one tab; a context manager."""

    def __enter__(self):
        with contextlib.ExitStack() as started:
            profile = started.enter_context(tempfile.TemporaryDirectory(prefix="firefox-", ignore_cleanup_errors=True))
            settings = (f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in SETTINGS.items())
            (pathlib.Path(profile) / "user.js").write_text("".join(settings))
            environment = {**os.environ, "DISPLAY": started.enter_context(display())}
            command = [FIREFOX, "--no-remote", "--profile", profile, "--remote-debugging-port", "0"]
            started.enter_context(process(command, stderr=subprocess.DEVNULL, env=environment))
            told = pathlib.Path(profile) / "WebDriverBiDiServer.json"
            until("Firefox listens", lambda: told.exists() and told.read_text())
            server = json.loads(told.read_text())
            url = f"ws://{server['ws_host']}:{server['ws_port']}/session"
            self.socket = started.enter_context(connect(url, open_timeout=SOON, max_size=None))
            self.number, self.complaints = 0, []
            self.ask("session.new", capabilities={})
            self.ask("session.subscribe", events=["log.entryAdded"])
            self.tab = self.ask("browsingContext.getTree")["contexts"][0]["context"]
            self.exits = started.pop_all()
        return self

    def __exit__(self, *_):
        self.exits.close()

    def ask(self, method, **parameters):
        """Runs a command of WebDriver BiDi; returns its result."""
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            heard = json.loads(self.socket.recv(SOON))
            if heard.get("method") == "log.entryAdded" and heard["params"]["level"] in ("error", "warn"):
                self.complaints.append(heard["params"]["text"])
            elif heard.get("id") == self.number:
                assert heard["type"] == "success", heard
                return heard["result"]

    def goto(self, url):
        self.ask("browsingContext.navigate", context=self.tab, url=url, wait="complete")

    def reload(self):
        self.ask("browsingContext.reload", context=self.tab, wait="complete")

    def frame(self):
        """The first frame of the page, for `evaluate`."""
        (tab,) = self.ask("browsingContext.getTree", root=self.tab)["contexts"]
        return tab["children"][0]["context"]

    def evaluate(self, expression, frame=None):
        """The value of an expression in the page, or in a frame of it."""
        text = f"JSON.stringify(({expression}) ?? null)"
        target = {"context": frame or self.tab}
        answer = self.ask("script.evaluate", expression=text, target=target, awaitPromise=True)
        assert answer["type"] == "success", answer
        return json.loads(answer["result"]["value"])
