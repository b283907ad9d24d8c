#!/usr/bin/env bash
# Runs worlds in your Webots through a fleet on this machine, with and without the sandbox, direct and relayed: a student
# starts one, plays it, is watched, loses the connection, comes back and leaves; another's is stopped. It prints a table
# to paste into an issue:
#
#   WEBOTS_HOME=/usr/local/webots tests/real-webots.sh [WORLD.wbt]...
#   tests/real-webots.sh --program PROGRAM [WORLD.wbt]...     # another program in its place, such as the demo simulator
#
# Without worlds it takes those of tests/real_webots: moved by physics, moved by a controller. Each is in the folder
# `worlds` of its project. Exit code: 0 if everything is as expected, 1 if not.
# FLEET_BIN names a folder with the programs (target/debug). Without a display it uses xvfb-run.
set -euo pipefail
here=$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")

program=
if [[ ${1-} == --program ]]; then
    program=$(readlink -e "${2?a program is missing}") || { echo "error: there is no $2" >&2; exit 1; }
    shift 2
elif [[ ! -x ${WEBOTS_HOME-}/webots ]]; then
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
exec ${display[@]+"${display[@]}"} "$python" "$here/real_webots/walk.py" "$program" "$@"
