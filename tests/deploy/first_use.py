"""First use of new simulation servers on Docker Swarm: docker inspect CONTAINER... | first_use.py VISITS BEGAN OLD...

VISITS is the JSON file of rehearse, BEGAN its start time, OLD are the containers from before. Prints the time from the
start of each new container to its first client; fails if one had none within LIMIT seconds.

The goal is five seconds. On two cores with other load, 1.3 to 4 were measured. The limit is higher because Docker is
slow on a busy machine.
"""

import datetime
import json
import pathlib
import re
import sys

LIMIT = 8.0

visits = json.loads(pathlib.Path(sys.argv[1]).read_text())["visits"]
began, old = float(sys.argv[2]), tuple(sys.argv[3:])
first = {}
for visit in visits:
    if visit["steps"]["waiting"] is not None:
        address = visit["server"].split("/")[1]
        first[address] = min(first.get(address, float("inf")), began + visit["asked"] + visit["steps"]["waiting"])
waits = []
for container in json.load(sys.stdin):
    if not container["Id"].startswith(old):
        # Docker reports nanoseconds, Python parses microseconds.
        started = re.sub(r"(\.\d{6})\d*Z", r"\1+00:00", container["State"]["StartedAt"])
        started = datetime.datetime.fromisoformat(started).timestamp()
        addresses = [network["IPAddress"] for network in container["NetworkSettings"]["Networks"].values()]
        waits.append(min(first.get(address, float("inf")) for address in addresses) - started)
print(", ".join(f"{wait:.1f}" for wait in sorted(waits)), "s")
sys.exit(not waits or max(waits) > LIMIT)
