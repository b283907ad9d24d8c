"""`tests/real-webots.sh`, with the demo simulator in Webots' place."""

import os
import subprocess
import unittest

from fleet import BIN, ROOT, SOON


class RealWebots(unittest.TestCase):
    def table(self, program):
        """The exit code, and the rows of the table."""
        done = subprocess.run(
            [ROOT / "tests/real-webots.sh", "--program", program],
            env={**os.environ, "FLEET_BIN": str(BIN)},
            capture_output=True,
            text=True,
            timeout=5 * SOON,
            check=False,
        )
        rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines() if line.startswith("| ")]
        self.assertGreater(len(rows), 4, done.stdout + done.stderr)
        return done.returncode, [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]

    def test_it_prints_how_each_world_has_fared(self):
        code, rows = self.table(BIN / "demo-simulator")
        self.assertEqual({row["result"] for row in rows}, {"ok"}, rows)
        self.assertEqual({row["stream"] for row in rows}, {"direct", "relay"})
        self.assertEqual({row["world"] for row in rows}, {"controller", "physics"})
        self.assertEqual({row["watched"] for row in rows}, {"yes"})
        self.assertTrue(all(float(row["real-time factor"]) > 0.2 for row in rows), rows)
        self.assertEqual(code, 0)

    def test_it_fails_with_a_program_that_is_no_webots(self):
        code, rows = self.table("/bin/false")
        self.assertFalse([row for row in rows if row["result"] == "ok"], rows)
        self.assertEqual(code, 1)


if __name__ == "__main__":
    unittest.main()
