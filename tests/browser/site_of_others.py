"""A web site of somebody else: the pages that docs/embedding.md prints, on another origin than the fleet."""

import http.server
import re
import threading

from fleet import ROOT, WORLD

GUIDE = ROOT / "docs/embedding.md"
FLEET = "https://simulations.example.org"
# The world in the printed pages.
PRINTED = "https://github.com/webots-fleet/demo/blob/main/worlds/playground.wbt"


def printed(heading, kind="html"):
    """The example of this kind below a heading, as it is printed."""
    chapter = GUIDE.read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return chapter.split(f"```{kind}\n")[1].split("\n```")[0]


class Site:
    """Serves pages below http://localhost, another site than 127.0.0.1; a context manager."""

    def __init__(self, fleet):
        self.fleet, self.pages = fleet, {}
        site = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                page = site.pages.get(self.path.split("?")[0].lstrip("/"))
                self.send_response(200 if page is not None else 204)
                if page is not None:
                    kind = "text/javascript" if self.path.endswith(".js") else "text/html"
                    self.send_header("Content-Type", f"{kind}; charset=utf-8")
                    self.send_header("Content-Length", str(len(page.encode())))
                self.end_headers()
                if page is not None:
                    self.wfile.write(page.encode())

            def log_message(self, *_):
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.origin = f"http://localhost:{self.server.server_port}"

    def put(self, name, text):
        """Serves a page with the addresses that its reader replaces; returns its URL."""
        address = self.fleet.session.url("").rstrip("/")
        replaced = text.replace(FLEET, address).replace(PRINTED, WORLD.format("playground"))
        assert not re.search(r"https://[a-z.]*example\.org", replaced), replaced
        self.pages[name] = replaced
        return f"{self.origin}/{name}"

    def __enter__(self):
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_):
        self.server.shutdown()
        self.server.server_close()
