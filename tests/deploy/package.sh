#!/usr/bin/env bash
# Installs, runs, upgrades, removes and purges the Debian package in a clean Debian whose systemd runs the servers.
#
# The Debian is made by debootstrap once, and kept in target/deploy/root. Each run looks at it through an overlay in
# memory, in namespaces of its own (processes, mounts, network), so that nothing of a run is left, however it ends.
# FLEET_BIN, an absolute path, names a folder with programs to package in place of building them.
set -Eeuo pipefail

cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../.."
readonly WORK=$PWD/target/deploy
readonly ROOT=$WORK/root
readonly PACKAGES=systemd,dbus,adduser,ca-certificates,git,curl,openssl,nginx-light

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

skip() { # A machine on which this can't be tested says so, and fails where everything has to be tested.
    printf 'not tested: %s\n' "$*" >&2
    [[ -z ${CI-} ]] || exit 1
    exit 0
}

# --- The machine: runs as process 1 of its own namespaces, see `boot`.

machine() { # CGROUP
    local device
    mount --make-rprivate /
    mount -t tmpfs -o size=2g tmpfs "$WORK/machine"
    mkdir "$WORK"/machine/{upper,work,root}
    mount -t overlay -o "lowerdir=$ROOT,upperdir=$WORK/machine/upper,workdir=$WORK/machine/work" overlay "$WORK/machine/root"
    cd "$WORK/machine/root"
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
    echo machine >etc/hostname
    echo '127.0.0.1 localhost machine' >etc/hosts
    # A change of root, since processes below a mere chroot may not have namespaces for users.
    pivot_root . mnt/old
    cd /
    umount --lazy mnt/old
    exec /usr/bin/env -i container=other PATH=/usr/sbin:/usr/bin:/sbin:/bin /lib/systemd/systemd --system
}

# --- The test.

in_machine() {
    nsenter --target "$init" --mount --uts --ipc --net --pid --cgroup --root -- \
        /usr/bin/env --chdir=/ -i PATH=/usr/sbin:/usr/bin:/sbin:/bin LC_ALL=C DEBIAN_FRONTEND=noninteractive "$@"
}

cgroup=
keeper=
finish() {
    local code=$?
    trap - EXIT
    if [[ -n $keeper ]]; then
        if ((code != 0)); then
            in_machine journalctl --no-pager --lines=40 >&2 || true
            in_machine sh -c 'tail -n 20 /var/log/webots-*/*/output.log' >&2 || true
        fi
        kill -KILL "$keeper" 2>/dev/null || true
        wait "$keeper" 2>/dev/null || true
    fi
    if [[ -n $cgroup ]]; then
        local patience=50
        until find "$cgroup" -depth -type d -exec rmdir {} + 2>/dev/null || ((patience-- == 0)); do sleep 0.1; done
    fi
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

boot() {
    local children
    cgroup=$(findmnt --first-only --noheadings --types cgroup2 --output TARGET) || skip 'there is no cgroup2 here'
    cgroup=$cgroup/webots-fleet-test.$$
    mkdir "$cgroup" || skip 'no control group can be made here'
    mkdir -p "$WORK/machine"
    (
        echo "$BASHPID" >"$cgroup/cgroup.procs"
        # Whatever ends this script ends the machine.
        exec setpriv --pdeathsig KILL unshare --mount --pid --fork --kill-child --cgroup --ipc --uts --net \
            "${BASH_SOURCE[0]}" machine </dev/null
    ) &
    keeper=$!
    for _ in {1..50}; do
        kill -0 "$keeper" 2>/dev/null || skip 'no namespaces or mounts can be made here'
        read -r children <"/proc/$keeper/task/$keeper/children" || true
        init=${children%% *}
        [[ -z $init || $(cat "/proc/$init/comm") != systemd ]] || break
        sleep 0.1
    done
    [[ -n ${init-} ]] || fail 'the machine does not start'
    eventually in_machine systemctl is-active dbus.service
    eventually in_machine systemctl is-active multi-user.target
}

make_root() {
    [[ -e $ROOT/.complete && $(<"$ROOT/.complete") == "$PACKAGES" ]] && return
    local mirror
    mirror=$(sed -nE 's/^URIs: *([^ ]+).*/\1/p; s/^deb (\[[^]]*\] )?([^ ]+).*/\2/p' \
        /etc/apt/sources.list /etc/apt/sources.list.d/*.{sources,list} 2>/dev/null || true)
    mirror=${mirror%%$'\n'*}
    [[ -n $mirror ]] || skip 'this is no Debian or Ubuntu with a package mirror'
    rm -rf "$ROOT"
    # shellcheck disable=SC1091
    debootstrap --variant=minbase --include="$PACKAGES" "$(. /etc/os-release && echo "$VERSION_CODENAME")" "$ROOT" "$mirror" \
        >"$WORK/debootstrap.log" 2>&1 || {
        tail -n 5 "$WORK/debootstrap.log" >&2
        fail 'debootstrap failed'
    }
    echo "$PACKAGES" >"$ROOT/.complete"
}

# Two packages with the same content: revisions 1 and 2.
make_packages() {
    local options=(--quiet --fast --compress-type gz --compress-system --deb-revision 1 --output "$WORK/packages/1.deb")
    rm -rf "$WORK/packages" "$WORK/unpacked"
    mkdir -p "$WORK/packages"
    if [[ -n ${FLEET_BIN-} ]]; then
        mkdir -p "$WORK/built"
        ln -sfn "$FLEET_BIN" "$WORK/built/release"
        CARGO_TARGET_DIR=$WORK/built deploy/build-deb --no-build "${options[@]}" >/dev/null
    else
        deploy/build-deb "${options[@]}" >/dev/null
    fi
    dpkg-deb --raw-extract "$WORK/packages/1.deb" "$WORK/unpacked"
    sed -i 's/^Version: .*-1$/Version: 999.0.0-2/' "$WORK/unpacked/DEBIAN/control"
    dpkg-deb -Zgzip -z1 --root-owner-group --build "$WORK/unpacked" "$WORK/packages/2.deb" >/dev/null
    rm -rf "$WORK/unpacked"
}

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

drains() { # UNIT
    [[ $(property "$1" StatusText) == draining:* ]]
}

# Whether a unit runs, with another process than this one.
is_another() { # UNIT PID
    [[ $(property "$1" ActiveState) == active && $(property "$1" MainPID) != "$2" ]]
}

# Every file of the machine that has to do with the package.
traces() {
    in_machine sh -c 'find / -xdev \( -name "*webots*" -o -name "*simulation-server*" -o -name "*session-server*" \) \
        -not -path "/mnt/*" -not -path "/proc/*" -not -path "/sys/*"; getent passwd | grep webots || true'
}

install_package() { # REVISION OPTION...
    local revision=$1
    shift
    in_machine apt-get install --yes --quiet --no-install-recommends "$@" "/mnt/packages/$revision.deb" 2>&1
}

main() {
    [[ $(id -u) == 0 ]] || skip 'only root can make a Debian of its own'
    local tool
    for tool in debootstrap dpkg-deb unshare nsenter setpriv pivot_root findmnt; do
        command -v "$tool" >/dev/null || skip "$tool is not installed"
    done
    mkdir -p "$WORK"
    make_root
    if ! command -v cargo-deb >/dev/null && [[ ! -x target/tools/bin/cargo-deb ]]; then
        echo 'builds cargo-deb, once'
        cargo install --quiet --locked --root target/tools cargo-deb
    fi
    make_packages
    boot

    echo 'installs, and starts nothing'
    [[ -z $(traces) ]] || fail "the machine is not clean: $(traces)"
    install_package 1 >"$WORK/install.log" || fail "$(<"$WORK/install.log")"
    [[ -z $(in_machine systemctl list-units --no-legend 'webots-*') ]] || fail 'something was started'
    [[ $(in_machine stat --format='%a %U %G' /etc/webots-fleet/session) == '750 root webots-session' ]] || fail 'the configuration is open'
    in_machine runuser -u webots-session -- simulation-server --version >/dev/null || fail 'the programs do not run'
    if in_machine runuser -u webots-simulation -- cat /etc/webots-fleet/session/main.json 2>/dev/null; then
        fail "a simulation can read the session server's secrets"
    fi
    in_machine systemd-analyze verify webots-session@main.service webots-simulation@main.service || fail 'systemd finds faults'

    echo 'starts both servers, simulation servers first'
    make_project
    in_machine systemctl enable --quiet webots-session@main webots-simulation@main
    # As the machine does when it boots.
    in_machine systemctl start multi-user.target
    answers 2000 /health ok || fail 'a simulation server that is ready does not answer'
    answers 1999 /health ok || fail 'a session server that is ready does not answer'
    local simulation session
    simulation=$(property webots-simulation@main ActiveEnterTimestampMonotonic)
    session=$(property webots-session@main InactiveExitTimestampMonotonic)
    ((simulation <= session)) || fail 'the session server was started first'
    [[ $(property webots-simulation@main StatusText) == 'listens on port 2000' ]] || fail 'no status is told'
    [[ $(property webots-simulation@main WatchdogTimestampMonotonic) -gt 0 ]] || fail 'the watchdog is not fed'
    # A machine that is busy otherwise makes it full.
    eventually answers 1999 /status '"state":"\(up\|full\)"'
    in_machine test -s /var/log/webots-simulation/simulation/output.log || fail 'there is no log'

    echo 'runs a simulation within the limits of the unit'
    simulate &
    eventually runs demo-simulator
    eventually grep --quiet --text 'webots:ws://localhost:2001' "$WORK/client.log"

    echo 'reloads, and comes back after a crash'
    in_machine sed -i 's/"localhost:2000"/"localhost:2000", "localhost:2200"/' /etc/webots-fleet/session/main.json
    in_machine systemctl reload webots-session@main
    eventually answers 1999 /status 2200
    local old
    old=$(property webots-session@main MainPID)
    in_machine sh -c "kill -KILL $old"
    eventually answers 1999 /health ok
    is_another webots-session@main "$old" || fail 'it was not started again'

    echo 'upgrades: configurations are kept, simulations run on'
    in_machine sed -i 's/"maxConnections": 20/"maxConnections": 7/' /etc/webots-fleet/simulation/main.json
    old=$(property webots-simulation@main MainPID)
    local old_session
    old_session=$(property webots-session@main MainPID)
    install_package 2 >"$WORK/install.log" || fail "$(<"$WORK/install.log")"
    grep --quiet 'webots-simulation@main.service runs on as it was' "$WORK/install.log" || fail "$(<"$WORK/install.log")"
    in_machine grep --quiet '"maxConnections": 7' /etc/webots-fleet/simulation/main.json || fail 'the configuration is lost'
    [[ $(property webots-simulation@main MainPID) == "$old" ]] || fail 'the simulation server was restarted'
    [[ $(property webots-session@main MainPID) != "$old_session" ]] || fail 'the session server was not restarted'
    runs demo-simulator >/dev/null || fail 'the simulation is gone'

    echo 'renews the simulation server when its last simulation has ended'
    in_machine webots-fleet-renew main >"$WORK/renew.log" &
    local renewal=$!
    eventually drains webots-simulation@main
    sleep 2
    runs demo-simulator >/dev/null || fail 'the simulation was lost'
    in_machine sh -c "kill $(in_machine cat /run/client.pid)"
    wait "$renewal" || fail "it was not renewed: $(<"$WORK/renew.log")"
    [[ $(property webots-simulation@main MainPID) != "$old" ]] || fail 'it is the old one'
    answers 2000 /status '"places":7' || fail 'it has not read its configuration'
    # A machine that is busy otherwise makes it full.
    eventually answers 1999 /status '"state":"\(up\|full\)"'

    echo 'does not try again with a wrong configuration'
    in_machine sh -c 'echo "{}" >/etc/webots-fleet/session/wrong.json'
    ! in_machine systemctl start webots-session@wrong 2>/dev/null || fail 'a wrong configuration is used'
    sleep 3
    [[ $(property webots-session@wrong NRestarts) == 0 ]] || fail 'it was tried again'
    [[ $(property webots-session@wrong ExecMainStatus) == 2 ]] || fail 'the exit code is another'

    echo 'is started again when it hangs'
    old=$(property webots-simulation@main MainPID)
    in_machine mkdir -p /run/systemd/system/webots-simulation@.service.d
    in_machine sh -c 'printf "[Service]\nWatchdogSec=2\n" >/run/systemd/system/webots-simulation@.service.d/test.conf'
    in_machine systemctl daemon-reload
    in_machine systemctl restart webots-simulation@main
    old=$(property webots-simulation@main MainPID)
    sleep 4
    [[ $(property webots-simulation@main MainPID) == "$old" ]] || fail 'a healthy server was ended'
    in_machine sh -c "kill -STOP $old"
    eventually is_another webots-simulation@main "$old"

    echo 'follows docs/deployment.md to https://fleet.example.org/viewer'
    follow_guide

    echo 'is removed: nothing runs, configurations stay'
    in_machine apt-get remove --yes --quiet webots-fleet >"$WORK/remove.log" 2>&1 || fail "$(<"$WORK/remove.log")"
    ! runs 'session-server|simulation-serv' || fail 'a server still runs'
    in_machine test -e /etc/webots-fleet/simulation/main.json || fail 'the configuration is gone'

    echo 'is purged: nothing is left'
    in_machine rm -rf /etc/nginx/sites-enabled/fleet /etc/nginx/sites-available/fleet
    in_machine rm -rf /run/systemd/system/webots-simulation@.service.d /srv/webots-demo
    in_machine dpkg --purge webots-fleet >"$WORK/purge.log" 2>&1 || fail "$(<"$WORK/purge.log")"
    [[ -z $(traces) ]] || fail "this is left: $(traces)"
    echo 'ok'
}

# Steps 4 to 6 of the guide, with its own configurations, and a certificate of a lab's authority as
# docs/deployment-web-server.md has it.
follow_guide() {
    local kind
    for kind in simulation session; do
        guided_configuration "$kind" | in_machine tee "/etc/webots-fleet/$kind/main.json" >/dev/null
        in_machine runuser -u "webots-$kind" -- "$kind-server" --check "/etc/webots-fleet/$kind/main.json" >/dev/null 2>"$WORK/check.log" ||
            fail "$(<"$WORK/check.log")"
        ! grep 'unknown key\|is not set' "$WORK/check.log" || fail 'the configuration in the guide has faults'
    done
    # shellcheck disable=SC2016
    in_machine sh -c '
        set -e
        echo 127.0.1.1 fleet.example.org >>/etc/hosts
        certificates=/etc/letsencrypt/live/fleet.example.org
        mkdir -p $certificates
        cd $certificates
        openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout authority.key -subj "/CN=Lab" \
            -out /usr/local/share/ca-certificates/lab-authority.crt 2>/dev/null
        openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout privkey.pem -subj "/CN=fleet" -out request 2>/dev/null
        printf "subjectAltName=DNS:fleet.example.org\nbasicConstraints=critical,CA:FALSE\n" >extensions
        openssl x509 -req -in request -CA /usr/local/share/ca-certificates/lab-authority.crt -CAkey authority.key -CAcreateserial \
            -extfile extensions -out fullchain.pem 2>/dev/null
        update-ca-certificates >/dev/null 2>&1
        rm /etc/nginx/sites-enabled/default
        ln -s ../sites-available/fleet /etc/nginx/sites-enabled/
        cat >/etc/nginx/sites-available/fleet' <deploy/nginx.conf
    in_machine systemctl restart webots-simulation@main
    in_machine systemctl restart webots-session@main
    in_machine systemctl restart nginx || fail "$(in_machine nginx -t 2>&1)"
    secure /monitor
    secure /viewer
    secure /2000/monitor
    eventually answers 1999 /status '"state":"\(up\|full\)"'
}

# A page through the web server, as visitors get it.
secure() { # PATH
    in_machine curl --silent --show-error --fail --max-time 3 --output /dev/null "https://fleet.example.org$1" || fail "https://fleet.example.org$1 is not there"
}

# The configuration that the guide shows for a server.
guided_configuration() { # KIND
    awk -v file="/etc/webots-fleet/$1/main.json" '
        index($0, "`" file "`") == 1 { wanted = 1 }
        /^```$/ { if (inside) exit }
        inside { print }
        /^```json$/ { if (wanted) inside = 1 }' docs/deployment.md
}

# A project to simulate, and the demo simulator in place of Webots.
make_project() {
    in_machine sh -c '
        set -e
        mkdir -p /srv/webots-demo/project/worlds
        cd /srv/webots-demo/project
        printf "#VRML_SIM R2025a utf8\nWorldInfo { basicTimeStep 32 }\nViewpoint { }\nRobot { name \"one\" }\n" >worlds/a.wbt
        git init --quiet --initial-branch=main
        git add .
        git -c user.name=Test -c user.email=test@localhost commit --quiet --message test
        sed -i "s|\"webotsHome\": .*|\"webots\": \"/usr/bin/demo-simulator\", \"gitMirrors\": {\"https://github.com/cyberbotics/demo\": \"file:/srv/webots-demo/project\"},|; s|\"xvfb\": true|\"xvfb\": false|" \
            /etc/webots-fleet/simulation/main.json'
}

# A client that asks for a simulation, and keeps its connection open until it is ended.
simulate() {
    local message='{"start":{"url":"https://github.com/cyberbotics/demo/blob/main/worlds/a.wbt"}}' mask='\x00\x00\x00\x00' text
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

if [[ ${1-} == machine ]]; then
    trap - EXIT INT TERM HUP
    machine
fi
main
