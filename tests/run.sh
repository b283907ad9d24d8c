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
# The C compiler links the programs; python3 and openssl make counterparts for mail and TLS; xvfb gives a display,
# bubblewrap sandboxes; the fleet is tested behind both web servers, by a real browser too, and its package and the guide
# to it in a Debian that debootstrap makes; nft loads the packet filter; promtool reads the alerts, dnsmasq leads to simulation servers, and kubectl
# puts what is for Kubernetes together.
tests/install.sh cc=gcc,libc6-dev git=git git-lfs=git-lfs flock=util-linux openssl=openssl python3=python3 python3-venv=python3-venv \
    Xvfb=xvfb bwrap=bubblewrap apache2=apache2-bin nginx=nginx setpriv=util-linux chromium=chromium \
    debootstrap=debootstrap dpkg-shlibdeps=dpkg-dev desktop-file-validate=desktop-file-utils xhost=x11-xserver-utils \
    systemd-analyze=systemd ip=iproute2 nft=nftables promtool=prometheus dnsmasq=dnsmasq-base kubectl=kubernetes-client
# dockerd would begin to run on a machine that has not asked for it.
[[ -z ${CI-} ]] || tests/install.sh dockerd=docker.io iptables=iptables docker-compose=docker-compose
tests/python.sh >/dev/null

start=$SECONDS
code=0
skipped=()
logs=$(mktemp -d)
declare -A scripts=()
# shellcheck disable=SC2317 # The trap calls it.
end_all() {
    for script in "${!scripts[@]}"; do kill -- "-${scripts[$script]}" 2>/dev/null || true; done
    wait
    rm -rf "$logs"
}
trap end_all EXIT
trap 'exit 130' INT TERM HUP

# Starts a script beside whatever else runs, in a process group of its own.
start() { # SCRIPT
    set -m
    FLEET_BIN=${FLEET_BIN:-$PWD/target/debug} "$1" >"$logs/${1//\//-}" 2>&1 </dev/null &
    set +m
    scripts[$1]=$!
}

# Waits for a script of tests, and shows what it said. One that can't be run on this machine has said why, and ends with 77.
finish() { # SCRIPT
    local result=0
    wait "${scripts[$1]}" || result=$?
    unset "scripts[$1]"
    printf '\n--- %s\n' "$1"
    cat "$logs/${1//\//-}"
    case $result in
        0) ;;
        77) skipped+=("$1") ;;
        *) code=$result ;;
    esac
}

# With arguments, only some tests are wanted.
(($# > 0)) || start tests/deploy/prepare.sh
# Most tests wait most of the time, for servers and timers.
RUST_TEST_THREADS=${RUST_TEST_THREADS:-$((2 * $(nproc)))} cargo test --locked --no-fail-fast "$@" || code=$?
if (($# == 0)); then
    # Where it has failed, the scripts that need it say why.
    wait "${scripts[tests/deploy/prepare.sh]}" || true
    unset 'scripts[tests/deploy/prepare.sh]'
    all=(tests/browser/run tests/deploy/package.sh tests/deploy/guide.sh)
    echo "runs side by side, and tells when each has ended: ${all[*]}"
    for script in "${all[@]}"; do start "$script"; done
    for script in "${all[@]}"; do finish "$script"; done
    # It measures times.
    start tests/swarm.sh
    finish tests/swarm.sh
fi
echo "tests: $(((SECONDS - start) / 60)) min $(((SECONDS - start) % 60)) s, build included"
((${#skipped[@]} == 0)) || echo "SKIPPED, not passed: ${skipped[*]}" >&2
exit "$code"
