#!/bin/sh
# Runs a command in a network of its own, in which nothing changes when interfaces of the machine do, those of containers in other
# tests for example: the loopback, and a way out that leads nowhere, which pasta wants to see. Without root it has that of the machine.
set -eu
if [ "$1" = --inside ]; then
    shift
    ip link set lo up
    ip link add eth0 type veth peer name eth1
    # Else the kernel adds addresses of IPv6 a second later.
    ip link set eth0 addrgenmode none
    ip link set eth1 addrgenmode none
    ip link set eth1 up
    ip link set eth0 up
    ip address add 192.0.2.2/24 dev eth0
    ip route add default via 192.0.2.1
    exec "$@"
fi
[ "$(id -u)" != 0 ] || ! unshare --net true 2>/dev/null || exec unshare --net "$0" --inside "$@"
exec "$@"
