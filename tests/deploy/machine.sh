# Machines for the scripts beside this one: clean Debian systems with a running systemd. To be sourced, with the script's own arguments.
#
# mmdebstrap makes the Debian once, in target/deploy. The scripts can run in parallel. Each machine uses it through an overlay in memory, with its
# own namespaces (processes, mounts, network), so that a run leaves nothing behind, however it ends.
# A script whose parts run in parallel exports PART, the name of the part that runs.
#
# FLEET_DISTRIBUTION and FLEET_MIRROR select another system, such as 'jammy' and 'http://archive.ubuntu.com/ubuntu'.
# FLEET_BIN, an absolute path, is a folder with programs to package instead of building them.
# shellcheck shell=bash
set -Eeuo pipefail

SCRIPT=$(readlink -f "$0")
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../.."
# shellcheck source=tests/debian.sh
. tests/debian.sh
# shellcheck disable=SC1091
readonly DISTRIBUTION=${FLEET_DISTRIBUTION:-$(. /etc/os-release && echo "${VERSION_CODENAME-}")}
# The folders shared by all scripts; WORK is this script's own.
readonly DEPLOY=$PWD/target/deploy
readonly ROOT=$DEPLOY/$DISTRIBUTION
WORK=${SCRIPT##*/}
readonly WORK=$DEPLOY/${WORK%.sh}${PART:+-$PART}
readonly PACKAGES=systemd,systemd-sysv,libpam-systemd,dbus,dbus-user-session,sudo,adduser,ca-certificates,openssl,curl
# Packages that are installed later, in machines without internet.
readonly LATER=(git git-lfs bubblewrap xvfb ufw nginx apache2 certbot needrestart nftables passt)

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

# Ends with 77, as skipped tests do, if this machine can't run the test; if everything must be tested (CI is set), it fails.
skip() { # WHY
    [[ -z ${CI-} ]] || fail "this has to be tested where CI is set, and can't: $*"
    printf 'skipped: %s: %s\n' "${SCRIPT##*/}" "$*" >&2
    exit 77
}

# --- A machine: runs as process 1 of its own namespaces, see `boot`.

machine() { # NAME
    local device folder=$WORK/machines/$1
    mount --make-rprivate /
    mount -t tmpfs -o size=3g tmpfs "$folder"
    mkdir "$folder"/{upper,work,root}
    mount -t overlay -o "lowerdir=$ROOT,upperdir=$folder/upper,workdir=$folder/work" overlay "$folder/root"
    cd "$folder/root"
    mount -t proc proc proc
    mount -t sysfs -o ro sys sys
    mount -t cgroup2 cgroup2 sys/fs/cgroup
    mount -t tmpfs tmpfs run
    mount -t tmpfs -o mode=755 tmpfs dev
    for device in null zero full random urandom tty; do
        touch "dev/$device"
        mount --bind "/dev/$device" "dev/$device"
    done
    mkdir dev/shm dev/pts mnt/packages mnt/old
    mount -t tmpfs -o mode=1777 tmpfs dev/shm
    mount -t devpts -o newinstance,ptmxmode=0666 devpts dev/pts
    ln -s pts/ptmx dev/ptmx
    mount --bind "$WORK/packages" mnt/packages
    echo "$1" >etc/hostname
    echo "127.0.0.1 localhost $1" >etc/hosts
    # Not chroot: it would prevent processes from creating user namespaces.
    pivot_root . mnt/old
    cd /
    umount --lazy mnt/old
    exec /usr/bin/env -i container=other PATH=/usr/sbin:/usr/bin:/sbin:/bin /lib/systemd/systemd --system
}

# --- Machines, seen from outside. Functions without a machine argument use the machine `here`.

here=
declare -A cgroups=() keepers=() inits=()

in_machine() {
    nsenter --target "${inits[$here]}" --mount --uts --ipc --net --pid --cgroup --root -- \
        /usr/bin/env --chdir=/ -i PATH=/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C DEBIAN_FRONTEND=noninteractive "$@"
}

shut_down() { # NAME
    local patience=50
    kill -KILL "${keepers[$1]}" 2>/dev/null || true
    wait "${keepers[$1]}" 2>/dev/null || true
    until find "${cgroups[$1]}" -depth -type d -exec rmdir {} + 2>/dev/null || ((patience-- == 0)); do sleep 0.1; done
    unset "keepers[$1]" "cgroups[$1]" "inits[$1]"
}

finish() {
    local code=$?
    trap - EXIT
    for here in "${!keepers[@]}"; do
        if ((code != 0)) && [[ -n ${inits[$here]-} ]]; then
            echo "--- $here ---" >&2
            in_machine journalctl --no-pager --lines=40 >&2 || true
            in_machine sh -c 'tail -n 20 /var/log/webots-*/*/output.log' >&2 || true
        fi
        shut_down "$here"
    done
    exit "$code"
}
trap 'printf "error: line %s: %s\n" "$LINENO" "$BASH_COMMAND" >&2' ERR
trap finish EXIT
trap 'exit 130' INT TERM HUP

eventually() { # COMMAND...
    local patience=600
    until "$@" >/dev/null 2>&1; do
        ((patience-- > 0)) || fail "waited in vain: $*"
        sleep 0.2
    done
}

# Starts a machine and makes it the current one, `here`.
boot() { # NAME
    local children top init=
    here=$1
    top=$(findmnt --first-only --noheadings --types cgroup2 --output TARGET) || skip 'there is no cgroup2 here'
    mkdir "$top/webots-fleet-test.$$.$here" || skip 'no control group can be made here'
    cgroups[$here]=$top/webots-fleet-test.$$.$here
    mkdir -p "$WORK/machines/$here"
    (
        echo "$BASHPID" >"${cgroups[$here]}/cgroup.procs"
        # The machine ends with this script, however that ends.
        exec setpriv --pdeathsig KILL unshare --mount --pid --fork --kill-child --cgroup --ipc --uts --net \
            "$SCRIPT" machine "$here" </dev/null
    ) &
    keepers[$here]=$!
    for _ in {1..300}; do
        kill -0 "${keepers[$here]}" 2>/dev/null || skip 'no namespaces or mounts can be made here'
        read -r children <"/proc/${keepers[$here]}/task/${keepers[$here]}/children" || true
        init=${children%% *}
        [[ -z $init || $(cat "/proc/$init/comm") != systemd ]] || break
        sleep 0.1
    done
    [[ -n $init ]] || fail 'the machine does not start'
    inits[$here]=$init
    eventually in_machine systemctl is-active dbus.service
    eventually in_machine systemctl is-active multi-user.target
}

# --- What a machine is made of.

make_root() {
    local made="$PACKAGES ${LATER[*]}"
    [[ ! -e $ROOT/.complete || $(<"$ROOT/.complete") != "$made" ]] || return 0
    [[ -n $(debian_mirror) ]] || skip 'this is no Debian or Ubuntu with a package mirror'
    rm -rf "$ROOT"
    echo "makes a clean $DISTRIBUTION, once"
    # Keeps the downloaded packages and the package lists. mmdebstrap turns recommended packages off, so they are requested here.
    make_debian "$DISTRIBUTION" "$PACKAGES" "$ROOT" --skip=cleanup/apt \
        --customize-hook="chroot \"\$1\" apt-get --option APT::Install-Recommends=true install --quiet --yes --download-only ${LATER[*]}" >"$WORK/mmdebstrap.log" 2>&1 || {
        tail -n 5 "$WORK/mmdebstrap.log" >&2
        fail 'mmdebstrap failed'
    }
    echo "$made" >"$ROOT/.complete"
}

# Whether the packages are up to date. Without FLEET_BIN they are always made again.
packages_are_made() {
    [[ -n ${FLEET_BIN-} && -e $DEPLOY/packages/of && $(<"$DEPLOY/packages/of") == "$FLEET_BIN" ]] &&
        [[ -z $(find "$FLEET_BIN"/{session-server,simulation-server,demo-simulator,rehearse} Cargo.* config deploy docs server.sh templates \
            -newer "$DEPLOY/packages/of" -print -quit) ]]
}

# Makes two packages: the current version, and a later one in which every program, an example and a configuration differ.
make_packages() {
    local file made=$DEPLOY/packages release=$DEPLOY/release unpacked=$DEPLOY/unpacked
    rm -rf "$made" "$release" "$unpacked"
    mkdir -p "$made"
    deploy/build-release "$release" -Zgzip -z1 >/dev/null
    (cd "$release" && sha256sum --check --quiet SHA256SUMS) || fail 'the checksums of the release are wrong'
    mv "$release"/*.deb "$made/1.deb"
    mv "$release"/*.tar.gz "$made/release.tar.gz"
    dpkg-deb --raw-extract "$made/1.deb" "$unpacked"
    sed -i 's/^Version: .*-1$/Version: 999.0.0-2/' "$unpacked/DEBIAN/control"
    # Bytes appended to a program do not change its behaviour.
    for file in "$unpacked"/usr/bin/* "$unpacked/usr/share/webots-fleet/nginx.conf"; do
        printf '\n# later\n' >>"$file"
    done
    sed -i 's/"maxConnections": 20/"maxConnections": 19/' "$unpacked/etc/webots-fleet/simulation/main.json"
    (cd "$unpacked" && find . -path ./DEBIAN -prune -o -type f -printf '%P\0' | xargs -0 md5sum >DEBIAN/md5sums)
    dpkg-deb -Zgzip -z1 --root-owner-group --build "$unpacked" "$made/2.deb" >/dev/null
    rm -rf "$unpacked" "$release"
    echo "${FLEET_BIN-}" >"$made/of"
}

# Prepares what does not need the programs under test. One script makes it, the others wait.
prepare_root() {
    local tool lock
    [[ $(id -u) == 0 ]] || skip 'only root can make a Debian of its own'
    for tool in mmdebstrap dpkg-deb unshare nsenter setpriv pivot_root findmnt; do
        command -v "$tool" >/dev/null || skip "$tool is not installed"
    done
    mkdir -p "$DEPLOY" "$WORK"
    exec {lock}>"$DEPLOY/.lock"
    flock "$lock"
    make_root
    exec {lock}>&-
}

# Prepares everything that machines need. One script makes the packages, the others wait.
prepare() {
    local lock
    prepare_root
    exec {lock}>"$DEPLOY/.packages.lock"
    flock "$lock"
    packages_are_made || make_packages
    rm -rf "$WORK/packages"
    cp -r "$DEPLOY/packages" "$WORK"
    exec {lock}>&-
}

# --- The guide.

readonly GUIDE=docs/deployment.md

# The commands of a section of the guide: all of its blocks, or the block of this number.
commands() { # HEADING [NUMBER]
    local found
    found=$(awk -v heading="$1" -v number="${2-0}" '
        /^```/ { if (!inside) block += wanted; inside = !inside; shell = $0 == "```sh"; next }
        !inside && /^#/ { sub(/^#+ /, ""); wanted = $0 == heading }
        inside && shell && wanted && (!number || block == number) { print }' "$GUIDE")
    [[ -n $found ]] || fail "$GUIDE has no commands $2 below '$1'"
    printf '%s\n' "$found"
}

# --- Checks of servers.

answers() { # PORT PATH WORDS
    local answer
    answer=$(in_machine curl --silent --fail --max-time 30 "http://127.0.0.1:$1$2") && grep --quiet -- "$3" <<<"$answer"
}

property() { # UNIT NAME
    in_machine systemctl show --property="$2" --value "$1"
}

# Whether a program whose name matches this pattern runs.
runs() { # PATTERN
    local names
    # Without those that have ended and nobody has waited for.
    names=$(in_machine sh -c 'cat /proc/[0-9]*/stat 2>/dev/null || true' | sed -n 's/^[0-9]* (\(.*\)) [^ZX] .*/\1/p')
    grep --quiet --line-regexp --extended-regexp -- "$1" <<<"$names"
}

# Whether a file is from the later package; /proc/PID/exe is the program that runs, upgraded or not.
is_later() { # FILE
    in_machine tail --bytes=8 "$1" | grep --quiet --text --line-regexp '# later'
}

drains() {
    answers 2000 /status '"draining":true'
}

# Whether a unit is active with a main process other than this one.
is_another() { # UNIT PID
    [[ $(property "$1" ActiveState) == active && $(property "$1" MainPID) != "$2" ]]
}

# Makes a git repository with a world.
make_project() { # FOLDER WORLD
    # shellcheck disable=SC2016
    in_machine sh -c '
        set -e
        mkdir -p "$1/$(dirname "$2")"
        cd "$1"
        printf "#VRML_SIM R2025a utf8\nWorldInfo { basicTimeStep 32 }\nViewpoint { }\nRobot { name \"one\" }\n" >"$2"
        git init --quiet
        git symbolic-ref HEAD refs/heads/main
        git add .
        git -c user.name=Test -c user.email=test@localhost commit --quiet --message test' project "$1" "$2"
}

# A client that starts a simulation and keeps its connection open until `leave` ends it.
simulate() { # URL
    local message="{\"start\":{\"url\":\"$1\"}}" mask='\x00\x00\x00\x00' text
    # With a mask of zeros, the text of a frame is unchanged.
    printf -v text '\\x81\\xfe\\x%02x\\x%02x%s%s' $((${#message} / 256)) $((${#message} % 256)) "$mask" "$message"
    # shellcheck disable=SC2016
    in_machine bash -c '
        echo $$ >/run/client.pid
        exec 3<>/dev/tcp/127.0.0.1/2000
        printf "GET /client HTTP/1.1\r\nHost: localhost:2000\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n" >&3
        printf "$1" >&3
        exec cat <&3' simulate "$text" >"$WORK/client.log" 2>/dev/null || true
}

# shellcheck disable=SC2016
leave() {
    in_machine sh -c 'kill "$(cat /run/client.pid)"'
}

# Whether the client has received more messages, such as the periodic heartbeats.
hears_more() { # LENGTH OF ITS LOG BEFORE
    (($(stat --format=%s "$WORK/client.log") > $1))
}

if [[ ${1-} == machine ]]; then
    trap - EXIT INT TERM HUP
    machine "$2"
fi
