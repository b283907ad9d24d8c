#!/usr/bin/env bash
# Runs all tests: tests/run.sh
# Or selected tests, within seconds once they are built: tests/run.sh ARGUMENT FOR cargo test...
# Installs missing packages through apt and prints them.
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."

command -v cargo >/dev/null || PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
command -v cargo >/dev/null || {
    echo 'error: cargo is missing; https://rustup.rs tells how to install it' >&2
    exit 1
}
# On Debian, web servers are in /usr/sbin, which only root has in its PATH.
PATH=$PATH:/usr/sbin
# The C compiler links the programs; python3 and openssl make counterparts for mail and TLS; xvfb provides a display,
# bubblewrap sandboxes, pasta their networks; the fleet is tested behind both web servers, also with real browsers; its package and the guide
# are tested in a Debian made by mmdebstrap; nft loads the packet filter; promtool checks the alerts, dnsmasq resolves names of simulation servers,
# and kubectl renders the files for Kubernetes.
tests/install.sh cc=gcc,libc6-dev node=nodejs git=git git-lfs=git-lfs flock=util-linux openssl=openssl python3=python3 python3-venv=python3-venv \
    Xvfb=xvfb bwrap=bubblewrap pasta=passt apache2=apache2-bin nginx=nginx setpriv=util-linux chromium=chromium \
    mmdebstrap=mmdebstrap dpkg-shlibdeps=dpkg-dev desktop-file-validate=desktop-file-utils xhost=x11-xserver-utils \
    systemd-analyze=systemd ip=iproute2 nft=nftables promtool=prometheus dnsmasq=dnsmasq-base kubectl=kubernetes-client
# The headless build of the browser takes half of the processor time, if the distribution has it.
! apt-cache show chromium-headless-shell >/dev/null 2>&1 ||
    tests/install.sh chromium-headless-shell=chromium-headless-shell || echo 'the browser tests take longer' >&2
skipped=() failed=()
# Not each distribution has it.
tests/install.sh firefox-esr=firefox-esr || skipped+=('the browser tests in Firefox')
# udev does this; without udev the device may be missing or accessible to root only.
if ((EUID == 0)) && [[ ! -c /dev/net/tun || $(stat --format=%a /dev/net/tun) != 666 ]]; then
    echo 'lets everybody open /dev/net/tun, as udev does'
    mkdir -p /dev/net
    { [[ -c /dev/net/tun ]] || mknod /dev/net/tun c 10 200; } && chmod 666 /dev/net/tun || echo 'that failed' >&2
fi
# Only with CI: the package would start dockerd on a developer's machine.
[[ -z ${CI-} ]] || tests/install.sh dockerd=docker.io iptables=iptables docker-compose=docker-compose
readonly CARGO=(cargo test --locked --no-fail-fast)
if (($# > 0)); then
    tests/python.sh >/dev/null
    exec "${CARGO[@]}" "$@"
fi

start=$SECONDS
logs=$(mktemp -d)
declare -A jobs=()
# shellcheck disable=SC2317 # The trap calls it.
end_all() {
    for job in "${!jobs[@]}"; do kill -- "-${jobs[$job]}" 2>/dev/null || true; done
    wait
    rm -rf "$logs"
}
trap end_all EXIT
trap 'exit 130' INT TERM HUP

# Starts a command in the background, in its own process group.
start() { # COMMAND...
    set -m
    FLEET_BIN=$PWD/target/debug FLEET_BUSY=$logs/busy "$@" >"$logs/${*//\//-}" 2>&1 </dev/null &
    set +m
    jobs[$*]=$!
}

# Waits for a command and prints its output. A command that can't run on this machine prints why and ends with 77.
finish() { # COMMAND...
    local result=0
    wait "${jobs[$*]}" || result=$?
    unset "jobs[$*]"
    printf '\n--- %s\n' "$*"
    cat "$logs/${*//\//-}"
    case $result in
        0) ;;
        77) skipped+=("$*") ;;
        *) failed+=("$*") ;;
    esac
}

elapsed() {
    echo "$(((SECONDS - start) / 60)) min $(((SECONDS - start) % 60)) s"
}

# Everything is built once, so incremental compilation would only cost time.
export CARGO_INCREMENTAL=0
start tests/deploy/prepare.sh
start tests/python.sh
! command -v dockerd >/dev/null || start tests/image_root.sh target/tmp/images.tar
cargo test --locked --no-run
# If these failed, the tests that need them report why.
wait "${jobs[@]}" || true
jobs=()
echo "built: $(elapsed)"

# All of these mostly wait, so they run in parallel. Machines and Docker images are kept in memory; with little memory, the
# commands run one after another.
memory=$(awk '$1 == "MemAvailable:" { print int($2 / 1024) }' /proc/meminfo)
beside=()
run_beside() { # COMMAND...
    beside+=("$*")
    start "$@"
    ((memory > 10000)) || finish "$@"
}
run_beside tests/own_network.sh "${CARGO[@]}" --test containers -- --skip on_a_quiet_machine
run_beside tests/deploy/package.sh
tests/own_tmp.sh "${CARGO[@]}" --lib --bins --test integration -- --skip on_a_quiet_machine 2>&1 | tee "$logs/cargo test" ||
    failed+=('cargo test')
run_beside tests/browser/run
run_beside "${CARGO[@]}" --test faults -- --skip on_a_quiet_machine
run_beside "${CARGO[@]}" --test simulation_limits
echo "run side by side, and tell when each has ended: ${beside[*]@Q}"
# While this file exists, the Swarm test only makes its images.
touch "$logs/busy"
((memory <= 10000)) || start tests/swarm.sh
for command in "${beside[@]}"; do
    # shellcheck disable=SC2086 # None of its words has a space.
    [[ -z ${jobs[$command]-} ]] || finish $command
done
# These depend on the speed of the machine: nothing runs beside them, and each runs alone.
start "${CARGO[@]}" --test integration --test faults on_a_quiet_machine -- --test-threads=1
finish "${CARGO[@]}" --test integration --test faults on_a_quiet_machine -- --test-threads=1
start tests/own_network.sh "${CARGO[@]}" --test containers on_a_quiet_machine
finish tests/own_network.sh "${CARGO[@]}" --test containers on_a_quiet_machine
rm "$logs/busy"
[[ -n ${jobs[tests/swarm.sh]-} ]] || start tests/swarm.sh
# The guide mostly unpacks packages with apt, while the Swarm test waits.
guide='nice -n 19 tests/deploy/guide.sh'
((memory > 10000)) || finish tests/swarm.sh
# shellcheck disable=SC2086
start $guide
[[ -z ${jobs[tests/swarm.sh]-} ]] || finish tests/swarm.sh
# shellcheck disable=SC2086
finish $guide

echo "tests: $(elapsed), build included"
((${#skipped[@]} == 0)) || echo "SKIPPED, not passed: ${skipped[*]}" >&2
((${#failed[@]} > 0)) || exit 0
for command in "${failed[@]}"; do
    printf '\n--- the end of what failed: %s\n' "$command"
    tail -n 80 "$logs/${command//\//-}"
done >&2
# Why, once more, where it is found soonest.
for command in "${failed[@]}"; do
    printf '\n--- why %s failed\n' "$command"
    grep --text --extended-regexp --after-context 2 '^error: |panicked at|^(ERROR|FAIL): |^AssertionError' \
        "$logs/${command//\//-}" | cut --characters -300 | head -n 30 || true
done >&2
printf 'FAILED: %s\n' "${failed[@]}" >&2
exit 1
