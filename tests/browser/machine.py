"""A fleet behind Apache or nginx with the rules of `deploy`: each port of Webots has a path of the web server."""

import contextlib
import pathlib
import re
import tempfile

from fleet import ROOT, Fleet, free_ports
from web_server import WebServer, adapted

# The second machine; the first one is the web server's.
THERE = "127.0.0.2"


def pattern(ports):
    return "|".join(str(port) for port in ports)


class Machine(Fleet):
    """A fleet of two machines, 127.0.0.1 and 127.0.0.2, whose https server on the first rewrites ports."""

    def __init__(self, program, places, simulation=None):
        self.exits = contextlib.ExitStack()
        folder = pathlib.Path(self.exits.enter_context(tempfile.TemporaryDirectory(prefix="fleet-web-")))
        folder.chmod(0o755)
        each = places + 12
        plain, https, inside, *_ = ports = range(first := free_ports(3 + 2 * each), first + 3 + 2 * each)
        self.host = f"localhost:{https}"
        self.ports = [ports[3 + number * each] for number in range(2)]
        here, there = ([*range(port, port + places + 1)] for port in self.ports)
        self.web = WebServer(program, folder / program)
        self.exits.callback(self.web.stop)
        try:
            rules = self._apache if program == "apache2" else self._nginx
            self.web.start(rules(plain, https, inside, here, there), ports=(plain, https))
            self.environment = {"SSL_CERT_FILE": str(self.web.authority)}
            public = {"server": self.host, "ssl": True, "portRewrite": True}
            super().__init__(
                {**public, "port": inside, "simulationServers": [f"{self.host}/{port}" for port in self.ports]},
                {**public, "maxConnections": places, **(simulation or {})},
            )
        except BaseException:
            self.exits.close()
            raise

    def _simulation(self, name, more):
        number = 0 if name == "one" else 1
        host = ("127.0.0.1", THERE)[number]
        # The web server connects to Webots on the machine that it runs on.
        self.environment["DEMO_SIMULATOR_BIND"] = host
        return super()._simulation(name, {**more, "bind": host, "port": self.ports[number]})

    def _apache(self, plain, https, session, here, there):
        return adapted(
            (ROOT / "deploy/apache.conf").read_text(),
            # First, as other numbers may hold this one.
            session=("1999", str(session)),
            further=("  #Rewrite", "  Rewrite"),
            name=(re.escape("fleet.example.org"), "localhost"),
            plain=(r"\*:80>", f"127.0.0.1:{plain}>"),
            https=(r"\*:443>", f"127.0.0.1:{https}>"),
            certificate=(r"/etc/letsencrypt/live/\$\{FLEET_HOST\}/fullchain.pem", str(self.web.chain)),
            key=(r"/etc/letsencrypt/live/\$\{FLEET_HOST\}/privkey.pem", str(self.web.key)),
            log=(r"\$\{APACHE_LOG_DIR\}", str(self.web.folder)),
            **self._ports(here, there),
            server=(r"\^/2000/", f"^/{here[0]}/"),
            at=("127.0.0.1:2000/", f"127.0.0.1:{here[0]}/"),
            other=(r"\^/3000/", f"^/{there[0]}/"),
            at_other=("192.0.2.3:3000/", f"{THERE}:{there[0]}/"),
            machine=("192.0.2.3", THERE),
        )

    def _nginx(self, plain, https, session, here, there):
        return adapted(
            (ROOT / "deploy/nginx.conf").read_text(),
            session=("1999", str(session)),
            certificate=("/etc/letsencrypt/live/fleet.example.org/fullchain.pem", str(self.web.chain)),
            key=("/etc/letsencrypt/live/fleet.example.org/privkey.pem", str(self.web.key)),
            name=(re.escape("fleet.example.org"), "localhost"),
            any_address=(r"listen \[::\]:[^\n]*", ""),
            plain=("listen 80;", f"listen 127.0.0.1:{plain};"),
            https=("listen 443 ssl;", f"listen 127.0.0.1:{https} ssl;"),
            log=("/var/log/nginx", str(self.web.folder)),
            further=("  #location", "  location"),
            lines=("  #  ", "    "),
            end=("  #}", "  }"),
            **self._ports(here, there),
            server=("  2000   127.0.0.1:2000;", f"  {here[0]} 127.0.0.1:{here[0]};"),
            other=("  #3000  192.0.2.3:3000;", f"  {there[0]} {THERE}:{there[0]};"),
            machine=("192.0.2.3", THERE),
        )

    def _ports(self, here, there):
        """The ports of Webots and editors on both machines."""
        return {
            "webots": (re.escape("200[1-9]|201[0-9]|2020"), pattern(here[1:])),
            "other_webots": (re.escape("300[1-9]|301[0-9]|3020"), pattern(there[1:])),
            "editors": (re.escape("250[1-9]|251[0-9]|2520"), pattern(port + 500 for port in here[1:])),
            "other_editors": (re.escape("350[1-9]|351[0-9]|3520"), pattern(port + 500 for port in there[1:])),
        }

    def url(self, path):
        return f"https://{self.host}/{path}"

    def logs(self):
        return super().logs() + self.web.logs()

    def close(self):
        super().close()
        self.exits.close()
