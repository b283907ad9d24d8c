"""One door to a fleet: nginx with the rules of `deploy`, and a stand-in for oauth2-proxy, where visitors sign in."""

import contextlib
import http.server
import re
import threading

from fleet import ROOT, Fleet, free_ports
from web_server import WebServer, adapted

COOKIE = "_oauth2_proxy"
MACHINES = ["127.0.0.2", "127.0.0.3"]


class SignIn(http.server.BaseHTTPRequestHandler):
    """Takes the cookie's value as the name of the signed-in user."""

    def do_GET(self):
        names = re.findall(f"{COOKIE}=([a-z]+)", self.headers.get("cookie", ""))
        if self.path != "/oauth2/auth":
            self.send_response(200)
        elif names:
            self.send_response(202)
            self.send_header("X-Auth-Request-Email", f"{names[0]}@school.example")
        else:
            self.send_response(401)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_):
        pass


class OneDoor(Fleet):
    """A fleet of two machines, 127.0.0.2 and 127.0.0.3, behind one https door where visitors sign in, or need not.

    Streams are relayed, so that only the simulation servers' own ports are forwarded.
    """

    def __init__(self, places, session=None, simulation=None, signs_in=True):
        self.exits = contextlib.ExitStack()
        sign_in = http.server.ThreadingHTTPServer(("127.0.0.1", 0), SignIn)
        self.exits.callback(sign_in.server_close)
        threading.Thread(target=sign_in.serve_forever, daemon=True).start()
        self.exits.callback(sign_in.shutdown)
        # Each simulation server needs the ports that follow its own.
        each = places + 12
        plain, self.https, inside, *_ = ports = range(first := free_ports(3 + 2 * each), first + 3 + 2 * each)
        self.hosts = [(host, ports[3 + number * each]) for number, host in enumerate(MACHINES)]
        self.host = f"localhost:{self.https}"
        public = {"publicUrl": f"wss://{self.host}/{{host}}/{{port}}"}
        super().__init__(
            {**public, "port": inside, **(session or {})},
            {
                **public,
                "maxConnections": places,
                "streaming": "relay",
                "userHeader": "X-Forwarded-User",
                **(simulation or {}),
            },
        )
        try:
            self._open(plain, sign_in.server_port if signs_in else None)
        except BaseException:
            self.close()
            raise

    def _simulation(self, name, more):
        host, port = self.hosts[0 if name == "one" else 1]
        return super()._simulation(name, {"server": host, "bind": host, "port": port, **more})

    def _open(self, plain, sign_in):
        """Starts nginx."""
        self.web = WebServer("nginx", self.folder / "nginx")
        self.exits.callback(self.web.stop)
        folder = self.web.folder
        users = "" if sign_in is None else self._users(sign_in)
        (folder / "users.conf").write_text(users)
        servers = "|".join(str(port) for _, port in self.hosts)
        site = adapted(
            (ROOT / "deploy/nginx-door.conf").read_text(),
            certificate=("/etc/letsencrypt/live/fleet.example.org/fullchain.pem", str(self.web.chain)),
            key=("/etc/letsencrypt/live/fleet.example.org/privkey.pem", str(self.web.key)),
            name=("fleet.example.org", "localhost"),
            any_address=(r"listen \[::\]:[^\n]*", ""),
            plain=("listen 80;", f"listen 127.0.0.1:{plain};"),
            https=("listen 443 ssl;", f"listen 127.0.0.1:{self.https} ssl;"),
            session=("192.0.2.1:1999", self.session.address),
            machines=(r"192\\\.0\\\.2\\\.\[0-9\]\+", r"127\.0\.0\.[23]"),
            # As the comment at the top of the file says for relayed streams, removes the location of Webots' own ports.
            streams=(r'  # Only for simulation servers with "streaming": "direct".*?\n  }\n', ""),
            servers=(r"\(\?<fleet_port>2000\)", f"(?<fleet_port>{servers})"),
            users=(
                '  proxy_set_header X-Forwarded-User "";\n',
                f'  proxy_set_header X-Forwarded-User "";\n  include {folder}/users.conf;\n',
            ),
            log=("/var/log/nginx/access.log", f"{folder}/access.log"),
            errors=("/var/log/nginx/error.log", f"{folder}/error.log"),
        )
        self.web.start(site)

    def _users(self, sign_in):
        """The rules that let in who has signed in."""
        return adapted(
            (ROOT / "deploy/nginx-users.conf").read_text(),
            sign_in=("127.0.0.1:4180", f"127.0.0.1:{sign_in}"),
            # The session server connects to simulation servers directly, and visitors come from this machine.
            unsigned=("allow 127.0.0.1;", ""),
            ports=(r"2000\|3000", "|".join(str(port) for _, port in self.hosts)),
        )

    def url(self, path):
        return f"https://{self.host}/{path}"

    def machine(self, server):
        """The door's URL of this server."""
        return self.url(f"{server.config['server']}/{server.port}")

    def logs(self):
        return super().logs() + self.web.logs()

    def close(self):
        self.exits.close()
        super().close()
