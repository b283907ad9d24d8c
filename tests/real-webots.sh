#!/usr/bin/env bash
# Runs worlds in your Webots through a fleet on this machine, at each level of isolation, direct and relayed: a student
# starts one, plays it, is watched, loses the connection, comes back and leaves; others are stopped, crash, or end with their
# server. It prints a table to paste into an issue:
#
#   WEBOTS_HOME=/usr/local/webots tests/real-webots.sh [OPTION]... [WORLD.wbt]...
#
#   --program PROGRAM    another program in Webots' place, such as the demo simulator
#   --isolation LEVEL    this level only: none, sandbox or container
#   --image IMAGE        for containers; without it that of the world's release, if Docker has it
#
# Without worlds it takes those of tests/real_webots: moved by physics, moved by a controller, with a camera (OpenGL), with
# the window of a robot, with assets from the internet. Each is in the folder `worlds` of its project. Exit code: 0 if
# everything is as expected, 1 if not.
# FLEET_BIN names a folder with the programs (target/debug). Without a display it uses xvfb-run.
set -euo pipefail
here=$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")

program='' options=()
while [[ ${1-} == --* ]]; do
    value=${2?"$1 needs a value"}
    if [[ $1 == --program ]]; then
        program=$(readlink -e "$value") || { echo "error: there is no $value" >&2; exit 1; }
        value=$program
    fi
    options+=("$1" "$value")
    shift 2
done
if [[ -z $program && ! -x ${WEBOTS_HOME-}/webots ]]; then
    echo "error: WEBOTS_HOME names no folder with webots" >&2
    exit 1
fi
display=()
if [[ -z $program && -z ${DISPLAY-} ]]; then
    command -v xvfb-run >/dev/null || { echo "error: there is no display, and no xvfb-run" >&2; exit 1; }
    display=(xvfb-run --auto-servernum)
fi
python=$("$here/python.sh")
export PYTHONDONTWRITEBYTECODE=1
exec ${display[@]+"${display[@]}"} "$python" "$here/real_webots/walk.py" ${options[@]+"${options[@]}"} "$@"
