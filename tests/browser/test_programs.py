"""Programs: the description of their interface fits the answers, its examples run, and a generated client works."""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import unittest
import urllib.error
import urllib.request
from collections import Counter

import jsonschema
import openapi_spec_validator
from case import BrowserTest
from fleet import ROOT, SOON, WORLD, until
from students import START

TOKEN = "0123456789abcdef0123456789abcdef"
KEY = "a key of a whole fleet"
# More than docs/programs.md shows.
CLIENT = """
import json, sys
from fleet_client import AuthenticatedClient
from fleet_client.api.default import list_simulations, stop_simulation, stop_simulations, get_status
from fleet_client.models import StopMany, StopOne

client = AuthenticatedClient(base_url=sys.argv[1], token=sys.argv[2])
everybody = list_simulations.sync(client=client)
print(sorted(one.label for one in everybody))
anna = next(one for one in everybody if one.label == "Anna")
print(stop_simulation.sync(anna.id, client=client, body=StopOne(reason="over")).stopped == [anna.id])
print(len(stop_simulations.sync(client=client, body=StopMany(label="Ben")).stopped))
print(get_status.sync(client=client).available)
"""


class Programs(BrowserTest):
    session = {"apiTokens": [{"name": "test", "token": TOKEN, "may": "act"}], "fleetKey": KEY}
    simulation = {"apiTokens": [{"name": "test", "token": TOKEN, "may": "act"}], "fleetKey": KEY}

    def setUp(self):
        self.students = self.open(self.fleet.session.url("viewer"))

    def tearDown(self):
        self.students.close()
        until("nobody is there", lambda: not json.loads(self.ask(self.fleet.session, "simulations")))

    def start(self, *names):
        for name in names:
            self.students.tab.evaluate(START, [WORLD.format("carousel"), name])
        self.students.tab.evaluate("Promise.all(simulations)")

        def started():
            everybody = json.loads(self.ask(self.fleet.session, "simulations"))
            return Counter(one["label"] for one in everybody if one["state"] in ("idle", "running"))

        until("all are listed as started", lambda: not Counter(names) - started())

    def ask(self, server, path, body=None):
        headers = {"Authorization": f"Bearer {TOKEN}"}
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(server.url(path), data, headers)
        with urllib.request.urlopen(request, timeout=SOON) as answer:
            return answer.read().decode()

    def run_example(self, *command, **more):
        environment = {**os.environ, "FLEET": self.fleet.session.url("").rstrip("/"), "TOKEN": TOKEN}
        options = {"env": environment, "capture_output": True, "text": True, "timeout": SOON}
        done = subprocess.run(command, check=False, **options, **more)
        self.assertEqual(done.returncode, 0, done.stderr)
        return done.stdout

    def test_the_description_fits_the_answers(self):
        session, simulation = self.fleet.session, self.fleet.simulation
        description = json.loads(session.get("openapi.json"))
        self.assertEqual(description, json.loads(simulation.get("openapi.json")))
        openapi_spec_validator.validate(description)
        self.start("Anna", "Ben")

        def check(answer, path, method="get", status="200"):
            schema = description["paths"][path][method]["responses"][status]["content"]["application/json"]["schema"]
            whole = {**schema, "components": description["components"]}
            jsonschema.Draft202012Validator(whole).validate(answer)
            return answer

        everybody = check(json.loads(self.ask(session, "simulations")), "/simulations")
        for server in (session, simulation, self.fleet.other):
            check(json.loads(self.ask(server, "status")), "/status")
            check(server.status(), "/status")
        for wrong in ([{"id": "1"}], [{**everybody[0], "unknown": 1}], {}):
            with self.assertRaises(jsonschema.ValidationError):
                check(wrong, "/simulations")
        with self.assertRaises(jsonschema.ValidationError):
            check({**session.status(), "unknown": 1}, "/status")
        one, other = everybody
        path = f"simulations/{one['id']}/stop"
        check(json.loads(self.ask(session, path, {"reason": "x"})), "/simulations/{id}/stop", "post", "202")
        many = self.ask(session, "simulations/stop", {"ids": [other["id"], "1-1"]})
        check(json.loads(many), "/simulations/stop", "post", "202")
        self.start("Chloe")
        of_one = json.loads(self.ask(session, "simulations"))
        chloe = next(entry for entry in of_one if entry["label"] == "Chloe")
        server = next(one for one in (simulation, self.fleet.other) if one.address == chloe["server"])
        path = f"simulations/{chloe['id']}/stop"
        check(json.loads(self.ask(server, path, {})), "/simulations/{id}/stop", "post", "202")
        # A body that is too long is refused as the description says.
        for path, methods in description["paths"].items():
            if "requestBody" in methods.get("post", {}):
                with self.assertRaises(urllib.error.HTTPError) as refused:
                    self.ask(session, path.removeprefix("/").replace("{id}", "1-1"), {"reason": "x" * 10_000})
                self.assertEqual(refused.exception.code, 413, path)
                self.assertIn("413", methods["post"]["responses"], path)
        # Every path is there, and needs what the description says.
        for path, methods in description["paths"].items():
            for method, operation in methods.items():
                server = simulation if path == "/drain" else session
                request = urllib.request.Request(
                    server.url(path.removeprefix("/").replace("{id}", "1-1")),
                    data=b"{}" if method == "post" else None,
                    method=method.upper(),
                )
                try:
                    status = urllib.request.urlopen(request, timeout=SOON).status
                except urllib.error.HTTPError as refused:
                    status = refused.code
                is_open = operation["security"] == [] or {} in operation["security"]
                self.assertEqual(status, 200 if is_open else 401, path)
                self.assertIn(str(status), operation["responses"], path)

    def test_the_examples_run(self):
        text = (ROOT / "docs/programs.md").read_text()
        (shell,) = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
        (python,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
        self.start("Anna", "Ben")
        said = self.run_example(sys.executable, "-c", python)
        self.assertRegex(said, r"^(Anna|Ben) (idle|running) https://\S+\n(Anna|Ben) (idle|running) https://\S+\n$")
        with tempfile.TemporaryDirectory() as folder:
            said = self.run_example("sh", "-e", "-c", shell, cwd=folder)
            self.assertIn('"label":"Anna"', said)
            self.assertRegex(said, r'\{"failed":\[\],"stopped":\["[0-9T-]+"\]\}ok')
            self.assertIn(",server\n", (pathlib.Path(folder) / "lesson.csv").read_text())
        everybody = lambda: json.loads(self.ask(self.fleet.session, "simulations"))
        until("Ben is left", lambda: [one["label"] for one in everybody()] == ["Ben"])

    def test_a_generated_client_stops_a_simulation_and_reads_the_class(self):
        with tempfile.TemporaryDirectory() as folder:
            description = pathlib.Path(folder) / "openapi.json"
            description.write_text(self.fleet.session.get("openapi.json"))
            config = pathlib.Path(folder) / "config.yml"
            config.write_text("post_hooks: []\n")
            generator = [sys.executable, "-m", "openapi_python_client", "generate", "--meta", "none"]
            package = f"{folder}/fleet_client"
            self.run_example(*generator, "--path", description, "--config", config, "--output-path", package)
            self.start("Anna", "Ben", "Ben")
            said = self.run_example(
                sys.executable, "-c", CLIENT, self.fleet.session.url("").rstrip("/"), TOKEN, cwd=folder
            )
            self.assertEqual(said, "['Anna', 'Ben', 'Ben']\nTrue\n2\nTrue\n")
            self.start("Chloe")
            (example,) = re.findall(r"```py\n(.*?)```", (ROOT / "docs/programs.md").read_text(), re.DOTALL)
            names = "import os\nFLEET, TOKEN = os.environ['FLEET'], os.environ['TOKEN']\n"
            self.run_example(sys.executable, "-c", names + example, cwd=folder)
            until("it stops all", lambda: not json.loads(self.ask(self.fleet.session, "simulations")))


if __name__ == "__main__":
    unittest.main()
