"""Connects two machines: cable.py PROCESS ADDRESS/BITS PROCESS ADDRESS/BITS

Each machine is a network namespace, given by a process in it, and gets an interface with an address. Packets sent on
one arrive at the other until this program ends.
"""

import contextlib
import ctypes
import fcntl
import os
import select
import struct
import subprocess
import sys

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x1, 0x1000
CLONE_NEWNET = 0x40000000
LONGEST = 65536


def end(process, address):
    """An end of the cable, in the namespace of a process."""
    with open(f"/proc/{process}/ns/net") as namespace:
        if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "can't enter the machine")
    interface = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(interface, TUNSETIFF, struct.pack("16sH", b"cable", IFF_TUN | IFF_NO_PI))
    for command in (["address", "add", address, "dev", "cable"], ["link", "set", "cable", "up"]):
        subprocess.run(["ip", *command], check=True)
    return interface


def main(one, its_address, other, others_address):
    ends = [end(one, its_address), end(other, others_address)]
    print("connected", flush=True)
    while True:
        for ready in select.select(ends, [], [])[0]:
            packet = os.read(ready, LONGEST)
            # The interface of a stopping machine goes down first; the packet is lost.
            with contextlib.suppress(OSError):
                os.write(ends[1 - ends.index(ready)], packet)


main(*sys.argv[1:])
