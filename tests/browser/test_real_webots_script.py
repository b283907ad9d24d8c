"""`tests/real-webots.sh`, with the demo simulator in Webots' place; `tests/containers` runs it with containers."""

import os
import pathlib
import re
import shutil
import subprocess
import unittest

from fleet import BIN, ROOT, SOON

PROJECT = ROOT / "tests/real_webots/project"
TIMES = ("ready s", "moving s", "resumed s", "end s", "stopped s", "crashed s", "server's end s")


class RealWebots(unittest.TestCase):
    def table(self, *arguments):
        """The exit code, the rows of the table, and the whole text."""
        done = subprocess.run(
            [ROOT / "tests/real-webots.sh", *arguments],
            env={**os.environ, "FLEET_BIN": str(BIN)},
            capture_output=True,
            text=True,
            timeout=5 * SOON,
            check=False,
        )
        rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines() if line.startswith("| ")]
        self.assertGreater(len(rows), 1, done.stdout + done.stderr)
        return done.returncode, [dict(zip(rows[0], row, strict=True)) for row in rows[1:]], done.stdout

    def test_it_prints_how_a_world_has_fared(self):
        world = PROJECT / "worlds/window.wbt"
        code, rows, text = self.table("--program", BIN / "demo-simulator", world)
        self.assertEqual({row["result"] for row in rows}, {"ok"}, rows)
        levels = ["none", "sandbox"] if shutil.which("bwrap") else ["none"]
        tried = [(row["isolation"], row["stream"], row["world"]) for row in rows]
        self.assertEqual(tried, [(level, way, "window") for level in levels for way in ("direct", "relay")])
        self.assertIn("Not tried: container: --image names no image", text)
        for row in rows:
            self.assertEqual((row["reset"], row["watched"], row["robot windows"]), ("yes", "yes", "1"), row)
            self.assertTrue(0.2 < float(row["real-time factor"]) < 1.5, row)
            self.assertGreater(int(row["memory MB"]), 0, row)
            for column in TIMES:
                self.assertTrue(0 <= float(row[column]) < SOON, row)
        self.assertEqual(code, 0)

    def test_it_fails_with_a_program_that_is_no_webots(self):
        world = PROJECT / "worlds/physics.wbt"
        code, rows, _ = self.table("--program", "/bin/false", "--isolation", "none", world)
        self.assertEqual(len(rows), 2, rows)
        self.assertFalse([row for row in rows if row["result"] == "ok"], rows)
        self.assertEqual(code, 1)

    def test_its_worlds_name_what_their_project_has(self):
        worlds = list((PROJECT / "worlds").glob("*.wbt"))
        self.assertGreater(len(worlds), 4)
        for world in worlds:
            text = world.read_text()
            self.assertTrue(text.startswith("#VRML_SIM R2023b utf8\n"), world)
            named = {
                *(f"controllers/{name}/{name}.py" for name in re.findall('controller "(.*)"', text)),
                *(f"plugins/robot_windows/{name}/{name}.html" for name in re.findall('window "(.*)"', text)),
                *(f"worlds/{name}" for name in re.findall('"(textures/.*)"', text)),
            }
            absent = [name for name in named if not pathlib.Path(PROJECT / name).is_file()]
            self.assertEqual(absent, [], world)


if __name__ == "__main__":
    unittest.main()
