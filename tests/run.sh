#!/usr/bin/env bash
# Runs all tests: tests/run.sh [ARGUMENTS FOR cargo test]
# Installs through apt what they need and the machine lacks, and says so.
set -eu
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."

command -v cargo >/dev/null || PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
command -v cargo >/dev/null || {
    echo 'error: cargo is missing; https://rustup.rs tells how to install it' >&2
    exit 1
}
# Debian has web servers where only root looks for programs.
PATH=$PATH:/usr/sbin
# The C compiler links the programs; python3 and openssl make counterparts for mail and TLS; xvfb gives a display; the
# fleet is tested behind both web servers, by a real browser too, and its package and the guide to it in a Debian that
# debootstrap makes.
tests/install.sh cc=gcc,libc6-dev git=git flock=util-linux openssl=openssl python3=python3 python3-venv=python3-venv \
    xvfb-run=xvfb,xauth apache2=apache2-bin nginx=nginx setpriv=util-linux chromium=chromium \
    debootstrap=debootstrap dpkg-shlibdeps=dpkg-dev desktop-file-validate=desktop-file-utils xhost=x11-xserver-utils \
    ip=iproute2
tests/python.sh >/dev/null

start=$SECONDS
code=0
cargo test --locked --no-fail-fast "$@" || code=$?
# With arguments, only some tests are wanted.
(($# > 0)) || FLEET_BIN=${FLEET_BIN:-$PWD/target/debug} tests/browser/run || code=$?
(($# > 0)) || FLEET_BIN=${FLEET_BIN:-$PWD/target/debug} tests/deploy/package.sh || code=$?
(($# > 0)) || FLEET_BIN=${FLEET_BIN:-$PWD/target/debug} tests/deploy/guide.sh || code=$?
echo "tests: $(((SECONDS - start) / 60)) min $(((SECONDS - start) % 60)) s, build included"
exit "$code"
