"""When new simulation servers on Docker Swarm were used first: docker inspect CONTAINER... | first_use.py VISITS BEGAN OLD...

VISITS is what rehearse has written, BEGAN when it was started, OLD are containers that were there before. Says how long after
its start each new one had its first client; fails where one had none, or only after LIMIT seconds.

Five seconds are asked of a fleet. Measured were 1.3 to 4 on two cores that had other work too; what runs is also Docker, which is
slower on a machine that does much else, so that the limit is more.
"""

import datetime
import json
import re
import sys

LIMIT = 8.0

visits = json.load(open(sys.argv[1]))["visits"]
began, old = float(sys.argv[2]), tuple(sys.argv[3:])
first = {}
for visit in visits:
    if visit["steps"]["waiting"] is not None:
        address = visit["server"].split("/")[1]
        first[address] = min(first.get(address, float("inf")), began + visit["asked"] + visit["steps"]["waiting"])
waits = []
for container in json.load(sys.stdin):
    if not container["Id"].startswith(old):
        # Python knows microseconds, Docker tells nanoseconds.
        started = re.sub(r"(\.\d{6})\d*Z", r"\1+00:00", container["State"]["StartedAt"])
        started = datetime.datetime.fromisoformat(started).timestamp()
        addresses = [network["IPAddress"] for network in container["NetworkSettings"]["Networks"].values()]
        waits.append(min(first.get(address, float("inf")) for address in addresses) - started)
print(", ".join(f"{wait:.1f}" for wait in sorted(waits)), "s")
sys.exit(not waits or max(waits) > LIMIT)
