#!/bin/sh
# Runs a command with its own /tmp in memory: thousands of short-lived files take a third of the processor time that they take on a disk,
# and mounts of others don't appear in it. Without root, with little memory, or in a clone below /tmp, the command uses the machine's /tmp.
set -eu
if [ "$1" = --inside ]; then
    shift
    mount -t tmpfs -o mode=1777 tmpfs /tmp
    exec "$@"
fi
case $PWD in /tmp/*) exec "$@" ;; esac
[ "$(awk '$1 == "MemAvailable:" { print int($2 / 1024) }' /proc/meminfo)" -gt 8000 ] || exec "$@"
[ "$(id -u)" != 0 ] || ! unshare --mount true 2>/dev/null || exec unshare --mount "$0" --inside "$@"
exec "$@"
