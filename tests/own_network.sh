#!/bin/sh
# Runs a command in its own network, unaffected by changes of the machine's interfaces, such as those of containers in other tests.
# It has the loopback and a default route to nowhere, which pasta needs. Without root, the command runs in the machine's network.
set -eu
if [ "$1" = --inside ]; then
    shift
    ip link set lo up
    ip link add eth0 type veth peer name eth1
    # Otherwise the kernel adds IPv6 addresses a second later.
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
