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
tests/install.sh cc=gcc,libc6-dev git=git git-lfs=git-lfs flock=util-linux openssl=openssl python3=python3 python3-venv=python3-venv \
    Xvfb=xvfb apache2=apache2-bin nginx=nginx setpriv=util-linux chromium=chromium \
    debootstrap=debootstrap dpkg-shlibdeps=dpkg-dev desktop-file-validate=desktop-file-utils xhost=x11-xserver-utils \
    systemd-analyze=systemd ip=iproute2
tests/python.sh >/dev/null

start=$SECONDS
code=0
cargo test --locked --no-fail-fast "$@" || code=$?
skipped=()
# Runs a script of tests. One that can't be run on this machine has said why, and ends with 77.
run() { # SCRIPT
    local result=0
    FLEET_BIN=${FLEET_BIN:-$PWD/target/debug} "$1" || result=$?
    case $result in
        0) ;;
        77) skipped+=("$1") ;;
        *) code=$result ;;
    esac
}
# With arguments, only some tests are wanted.
if (($# == 0)); then
    run tests/browser/run
    run tests/deploy/package.sh
    run tests/deploy/guide.sh
fi
echo "tests: $(((SECONDS - start) / 60)) min $(((SECONDS - start) % 60)) s, build included"
((${#skipped[@]} == 0)) || echo "SKIPPED, not passed: ${skipped[*]}" >&2
exit "$code"
