"""webots.cloud on this machine: Apache, PHP and MariaDB with the sources in the folder that WEBOTS_CLOUD_SITE names.

They are those of https://github.com/cyberbotics/webots-cloud; the Debian packages are libapache2-mod-php, php-mysql and
mariadb-server. The site is set up as docs/webots-cloud.md says, in front of a fleet.
"""

import contextlib
import glob
import os
import pathlib
import shutil
import subprocess
import tempfile

from fleet import until
from web_server import WebServer

SOURCES = pathlib.Path(os.environ.get("WEBOTS_CLOUD_SITE", "/nonexistent"))
NAME = "webots.test"
DATABASE = {"database_host": "localhost", "database_name": "webots-cloud", "database_username": "admin"}
INSTALL, SERVER = shutil.which("mariadb-install-db"), shutil.which("mariadbd") or "/usr/sbin/mariadbd"
PHP = "/usr/lib/apache2/modules/libphp*.so"


def missing():
    """What this machine lacks; empty if the site can run."""
    if not (SOURCES / "httpdocs/ajax/server/session.php").exists():
        return "WEBOTS_CLOUD_SITE names no folder with the sources of webots.cloud, see tests/browser/webots_site.py"
    if INSTALL is None or not glob.glob(PHP):
        return "apt install libapache2-mod-php php-mysql mariadb-server"
    return "" if os.geteuid() == 0 else "the site's database and web server need root"


class Site:
    """The site, on port 443: its pages ask for its name alone. `door` is the URL of the fleet's session server, whose
    certificate `authority` has issued."""

    def __init__(self, door, authority):
        self.exits = contextlib.ExitStack()
        self.folder = pathlib.Path(self.exits.enter_context(tempfile.TemporaryDirectory(prefix="webots-site-")))
        # Apache's processes are another user's.
        self.folder.chmod(0o755)
        self.socket = self.folder / "database.sock"
        try:
            self._start_database()
            self._install()
            self._start_web(door, authority)
        except BaseException:
            self.close()
            raise

    def _start_database(self):
        data = self.folder / "data"
        quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.STDOUT}
        subprocess.run(
            [INSTALL, "--no-defaults", f"--datadir={data}", "--user=root", "--skip-test-db"], check=True, **quiet
        )
        options = [f"--datadir={data}", f"--socket={self.socket}", "--skip-networking", "--user=root"]
        with (self.folder / "database.txt").open("w") as output:
            database = subprocess.Popen(
                [SERVER, "--no-defaults", *options], stdin=subprocess.DEVNULL, stdout=output, stderr=output
            )
        self.exits.callback(database.wait)
        self.exits.callback(database.terminate)
        until("the database runs", lambda: self.socket.exists() or database.poll() is not None)
        self.socket.chmod(0o777)
        self.query("CREATE DATABASE `webots-cloud`; CREATE USER admin@localhost; GRANT ALL ON *.* TO admin@localhost")
        self.query((SOURCES / "database/webots-cloud.sql").read_text())

    def query(self, text):
        """Runs SQL statements; returns what they print."""
        client = ["mariadb", "--no-defaults", f"--socket={self.socket}", "--user=root", "--skip-column-names"]
        database = [] if text.startswith("CREATE DATABASE") else ["webots-cloud"]
        return subprocess.run([*client, *database], input=text, check=True, capture_output=True, text=True).stdout

    def _install(self):
        """The name of the folder is the branch that its pages show."""
        self.root = self.folder / "main"
        shutil.copytree(SOURCES, self.root, ignore=shutil.ignore_patterns(".git"))
        values = {**DATABASE, "database_password": ""}
        lines = "".join(f"${name} = '{value}';\n" for name, value in values.items())
        (self.root / "php/database.php").write_text(f"<?php\n{lines}?>")

    def _start_web(self, door, authority):
        # PHP trusts it too.
        shutil.copy(authority, self.folder / "authority.pem")
        self.web = WebServer("apache2", self.folder / "apache", names=[NAME])
        self.exits.callback(self.web.stop)
        site = f"""
LoadModule php_module {glob.glob(PHP)[0]}
<VirtualHost 127.0.0.1:443>
  ServerName {NAME}
  DocumentRoot {self.root}/httpdocs
  DirectoryIndex index.html
  <Directory {self.root}/httpdocs>
    AllowOverride All
    Require all granted
  </Directory>
  <FilesMatch "\\.php$">
    SetHandler application/x-httpd-php
  </FilesMatch>
  php_admin_value mysqli.default_socket {self.socket}
  php_admin_value openssl.cafile {self.folder}/authority.pem
  SSLEngine on
  SSLCertificateFile {self.web.chain}
  SSLCertificateKeyFile {self.web.key}

  SSLProxyEngine on
  RewriteEngine on
  RewriteRule ^/ajax/server/session\\.php$ {door}session [P,QSA]
</VirtualHost>
"""
        # PHP needs a process for each request.
        self.web.start(site, ports=[443], modules=["mpm_prefork"])

    def url(self, path):
        return f"https://{NAME}/{path}"

    def logs(self):
        return self.web.logs()

    def close(self):
        self.exits.close()
