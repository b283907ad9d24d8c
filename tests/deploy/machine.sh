# Machines for the scripts beside this one: clean Debians whose systemd runs. To be sourced, with the script's own arguments.
#
# The Debian is made by mmdebstrap once, and kept in target/deploy. The scripts can run side by side. Each machine looks at it through an overlay in
# memory, in namespaces of its own (processes, mounts, network), so that nothing of a run is left, however it ends.
# A script of several parts that run side by side exports PART, the name of this one.
#
# FLEET_DISTRIBUTION and FLEET_MIRROR, say 'jammy' and 'http://archive.ubuntu.com/ubuntu', make another system of it.
# FLEET_BIN, an absolute path, names a folder with programs to package in place of building them.
# shellcheck shell=bash
set -Eeuo pipefail

SCRIPT=$(readlink -f "$0")
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../.."
# shellcheck source=tests/debian.sh
. tests/debian.sh
# shellcheck disable=SC1091
readonly DISTRIBUTION=${FLEET_DISTRIBUTION:-$(. /etc/os-release && echo "${VERSION_CODENAME-}")}
# Shared by all scripts, and this one's own.
readonly DEPLOY=$PWD/target/deploy
readonly ROOT=$DEPLOY/$DISTRIBUTION
WORK=${SCRIPT##*/}
readonly WORK=$DEPLOY/${WORK%.sh}${PART:+-$PART}
readonly PACKAGES=systemd,systemd-sysv,libpam-systemd,dbus,dbus-user-session,sudo,adduser,ca-certificates,openssl,curl
# What is installed later, in machines that can't reach the internet.
readonly LATER=(git git-lfs bubblewrap xvfb ufw nginx apache2 certbot needrestart nftables passt)

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

# Where this can't be tested it has not passed: it ends with 77, as skipped tests do; where everything has to be tested
# (CI is set) it has failed.
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
    # A change of root, since processes below a mere chroot may not have namespaces for users.
    pivot_root . mnt/old
    cd /
    umount --lazy mnt/old
    exec /usr/bin/env -i container=other PATH=/usr/sbin:/usr/bin:/sbin:/bin /lib/systemd/systemd --system
}

# --- Machines, seen from outside. Functions that name none are about the machine `here`.

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
    local patience=150
    until "$@" >/dev/null 2>&1; do
        ((patience-- > 0)) || fail "waited in vain: $*"
        sleep 0.2
    done
}

# Starts a machine, and makes it the one that is meant from now on.
boot() { # NAME
    local children top init=
    here=$1
    top=$(findmnt --first-only --noheadings --types cgroup2 --output TARGET) || skip 'there is no cgroup2 here'
    mkdir "$top/webots-fleet-test.$$.$here" || skip 'no control group can be made here'
    cgroups[$here]=$top/webots-fleet-test.$$.$here
    mkdir -p "$WORK/machines/$here"
    (
        echo "$BASHPID" >"${cgroups[$here]}/cgroup.procs"
        # Whatever ends this script ends the machine.
        exec setpriv --pdeathsig KILL unshare --mount --pid --fork --kill-child --cgroup --ipc --uts --net \
            "$SCRIPT" machine "$here" </dev/null
    ) &
    keepers[$here]=$!
    for _ in {1..50}; do
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
    # What was downloaded stays, and the lists of packages. mmdebstrap itself wants no recommended packages.
    make_debian "$DISTRIBUTION" "$PACKAGES" "$ROOT" --skip=cleanup/apt \
        --customize-hook="chroot \"\$1\" apt-get --option APT::Install-Recommends=true install --quiet --yes --download-only ${LATER[*]}" >"$WORK/mmdebstrap.log" 2>&1 || {
        tail -n 5 "$WORK/mmdebstrap.log" >&2
        fail 'mmdebstrap failed'
    }
    echo "$made" >"$ROOT/.complete"
}

# Whether the packages are of these programs and files. What is to be built is always packaged anew.
packages_are_made() {
    [[ -n ${FLEET_BIN-} && -e $DEPLOY/packages/of && $(<"$DEPLOY/packages/of") == "$FLEET_BIN" ]] &&
        [[ -z $(find "$FLEET_BIN"/{session-server,simulation-server,demo-simulator,rehearse} Cargo.* config deploy docs server.sh templates \
            -newer "$DEPLOY/packages/of" -print -quit) ]]
}

# Two packages: what is built here, and a later version in which every program, an example and a configuration differ.
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
    # What follows a program in its file does not change what it does.
    for file in "$unpacked"/usr/bin/* "$unpacked/usr/share/webots-fleet/nginx.conf"; do
        printf '\n# later\n' >>"$file"
    done
    sed -i 's/"maxConnections": 20/"maxConnections": 19/' "$unpacked/etc/webots-fleet/simulation/main.json"
    (cd "$unpacked" && find . -path ./DEBIAN -prune -o -type f -printf '%P\0' | xargs -0 md5sum >DEBIAN/md5sums)
    dpkg-deb -Zgzip -z1 --root-owner-group --build "$unpacked" "$made/2.deb" >/dev/null
    rm -rf "$unpacked" "$release"
    echo "${FLEET_BIN-}" >"$made/of"
}

# What takes no programs under test. One script makes it, the others wait.
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

# Everything that machines need. The packages are made by one script, too.
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

# The commands of a part of the guide: all of its blocks, or the one of this number.
commands() { # HEADING [NUMBER]
    local found
    found=$(awk -v heading="$1" -v number="${2-0}" '
        /^```/ { if (!inside) block += wanted; inside = !inside; shell = $0 == "```sh"; next }
        !inside && /^#/ { sub(/^#+ /, ""); wanted = $0 == heading }
        inside && shell && wanted && (!number || block == number) { print }' "$GUIDE")
    [[ -n $found ]] || fail "$GUIDE has no commands $2 below '$1'"
    printf '%s\n' "$found"
}

# --- What is asked of servers.

answers() { # PORT PATH WORDS
    local answer
    answer=$(in_machine curl --silent --fail --max-time 3 "http://127.0.0.1:$1$2") && grep --quiet -- "$3" <<<"$answer"
}

property() { # UNIT NAME
    in_machine systemctl show --property="$2" --value "$1"
}

# Whether a program runs that is called so.
runs() { # PATTERN
    local names
    names=$(in_machine sh -c 'cat /proc/[0-9]*/comm 2>/dev/null || true')
    grep --quiet --line-regexp --extended-regexp -- "$1" <<<"$names"
}

# Whether a file is the later package's; /proc/PID/exe is the program that runs, upgraded or not.
is_later() { # FILE
    in_machine tail --bytes=8 "$1" | grep --quiet --text --line-regexp '# later'
}

drains() {
    answers 2000 /status '"draining":true'
}

# Whether a unit runs, with another process than this one.
is_another() { # UNIT PID
    [[ $(property "$1" ActiveState) == active && $(property "$1" MainPID) != "$2" ]]
}

# A git repository with a world.
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

# A client that asks for a simulation, and keeps its connection open until it is ended, see `leave`.
simulate() { # URL
    local message="{\"start\":{\"url\":\"$1\"}}" mask='\x00\x00\x00\x00' text
    # Masked with zeros, the text of a frame is the text itself.
    printf -v text '\\x81\\xfe\\x%02x\\x%02x%s%s' $((${#message} / 256)) $((${#message} % 256)) "$mask" "$message"
    # shellcheck disable=SC2016
    in_machine bash -c '
        exec 3<>/dev/tcp/127.0.0.1/2000
        printf "GET /client HTTP/1.1\r\nHost: localhost:2000\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n" >&3
        printf "$1" >&3
        echo $$ >/run/client.pid
        exec cat <&3' simulate "$text" >"$WORK/client.log" 2>/dev/null || true
}

# shellcheck disable=SC2016
leave() {
    in_machine sh -c 'kill "$(cat /run/client.pid)"'
}

# Whether the client is told that its simulation is alive, as it is every few seconds.
hears_more() { # LENGTH OF ITS LOG BEFORE
    (($(stat --format=%s "$WORK/client.log") > $1))
}

if [[ ${1-} == machine ]]; then
    trap - EXIT INT TERM HUP
    machine "$2"
fi
