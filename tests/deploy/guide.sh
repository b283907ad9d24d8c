#!/usr/bin/env bash
# Runs the commands of docs/deployment.md in clean machines: from the first one to a simulation in a browser over https
# and wss, with nginx and with Apache, on one machine and on two, and through an upgrade.
# tests/deploy/machine.sh describes these machines and the environment variables.
#
# Without internet there are stand-ins: the package is built before, Webots is the demo simulator in a package of that
# name, certbot is the script beside this one, the repository of the lab's world is on the machine.
#
# guide.sh [nginx|apache]: both parts in parallel, or only the part that begins with this web server.
[[ ${1-} == machine ]] || export PART=${1-}
# shellcheck source=tests/deploy/machine.sh
. "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/machine.sh"

readonly FRONT=192.0.2.1 FURTHER=192.0.2.3
readonly BROWSER=$PWD/target/test-venv/bin/python

# Filters out what concerns the session server.
for_simulations_only() {
    awk '/tee .*\/session\// { skipped = 1 } !skipped && !/webots-session|session-server/; /^END$/ { skipped = 0 }'
}

# Runs the commands of its input as the machine's user, with the guide's variables.
follow() { # HOST
    { commands 'What you need' | sed "s|^HOST=.*|HOST=$1|" && cat; } | in_machine tee /tmp/commands >/dev/null
    in_machine runuser -l lab -c 'bash -euxo pipefail /tmp/commands </dev/null' >"$WORK/guide.log" 2>&1 ||
        fail "$here: $(tail -n 30 "$WORK/guide.log")"
}

# A machine as at the beginning of the guide, with its name in the hosts file in place of DNS.
fresh() { # MACHINE ADDRESS
    boot "$1"
    nsenter --target "${inits[$1]}" --net ip address add "$2/32" dev lo
    # shellcheck disable=SC2016
    in_machine sh -c '
        set -e
        printf "%s\n" "$1 fleet.lab.example www.fleet.lab.example" "$2 gpu2.lab.example www.gpu2.lab.example" >>/etc/hosts
        useradd --create-home --shell /bin/bash lab
        echo "lab ALL=(ALL) NOPASSWD: ALL" >/etc/sudoers.d/lab
        echo "APT::Get::Assume-Yes true;" >/etc/apt/apt.conf.d/yes
        mkdir -p ~lab/webots-fleet/target/debian
        cp /mnt/packages/1.deb ~lab/webots-fleet/target/debian/webots-fleet_1.deb
        cp /mnt/packages/webots.deb ~lab/webots_R2025a_amd64.deb
        cp -r /mnt/packages/authority /etc
        cp /etc/authority/certificate.pem /usr/local/share/ca-certificates/authority.crt
        update-ca-certificates >/dev/null 2>&1
        install /mnt/packages/certbot /usr/local/bin/certbot' fresh "$FRONT" "$FURTHER"
}

# Makes the stand-ins.
make_stand_ins() {
    local webots=$WORK/webots
    rm -rf "$webots"
    mkdir -p "$webots/DEBIAN" "$webots/usr/local/webots" "$WORK/packages/authority"
    printf '%s\n' 'Package: webots' 'Version: 2025a' 'Architecture: amd64' 'Maintainer: Test <test@localhost>' \
        'Description: stands in for Webots' >"$webots/DEBIAN/control"
    # Like Webots, it listens on all addresses and needs a display.
    cat >"$webots/usr/local/webots/webots" <<'END'
#!/bin/sh
test -S "/tmp/.X11-unix/X${DISPLAY#:}" || { echo "there is no display $DISPLAY" && exit 1; }
DEMO_SIMULATOR_BIND=0.0.0.0 exec demo-simulator "$@"
END
    chmod +x "$webots/usr/local/webots/webots"
    dpkg-deb -Zgzip -z1 --root-owner-group --build "$webots" "$WORK/packages/webots.deb" >/dev/null
    cp tests/deploy/certbot "$WORK/packages"
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj '/CN=An authority' \
        -keyout "$WORK/packages/authority/key.pem" -out "$WORK/packages/authority/certificate.pem" 2>/dev/null
}

# Redirects the guide's repository, which the machine can't reach, to a local one. Other load on this machine must not make
# the servers full. The client of `simulate` answers no ping, and opens no stream.
adapt() {
    in_machine test -e /srv/arm || make_project /srv/arm worlds/arm.wbt
    in_machine sed -i 's|"allowedRepositories"|"gitMirrors": {"https://github.com/your-lab/arm": "file:/srv/arm"}, "timing": {"arrival": 0, "silence": 3600}, &|' \
        /etc/webots-fleet/simulation/main.json
    in_machine sed -i 's|"simulationServers": \["fleet|"loadThreshold": 1000, &|' /etc/webots-fleet/session/main.json
}

# Whether a page contains these words, through the web server.
page() { # URL WORDS
    local answer
    answer=$(in_machine curl --silent --show-error --fail --max-time 30 "$1") && grep --quiet -- "$2" <<<"$answer"
}

status_of() { # URL OPTION...
    in_machine curl --silent --output /dev/null --max-time 30 --write-out '%{http_code}' "$@" || true
}

# Ports of the machine's services that are not part of the fleet.
readonly PRIVATE=(1 22 2021 5432 8000)
only_the_fleet_is_reachable() { # HOST
    local port
    for port in "${PRIVATE[@]}"; do
        in_machine systemd-run --quiet --unit="private-$port" --working-directory=/srv python3 -m http.server --bind 127.0.0.1 "$port"
        eventually in_machine curl --silent --fail --output /dev/null "http://127.0.0.1:$port/"
        [[ $(status_of "https://$1/$port/") == 404 ]] || fail "port $port is reachable"
    done
    [[ $(status_of "https://$1/3000/monitor") == 404 ]] || fail 'another machine is asked for, and there is none'
}

# Whether a service that listens on all addresses of one machine is reachable from another.
firewall_lets_in() { # ADDRESS ITS MACHINE PORT
    local from=$here
    here=$2
    in_machine systemd-run --quiet --unit="open-$3" --working-directory=/srv python3 -m http.server "$3"
    eventually in_machine curl --silent --fail --output /dev/null "http://127.0.0.1:$3/"
    here=$from
    in_machine curl --silent --fail --max-time 10 --output /dev/null "http://$1:$3/"
}

# Opens the WebSockets of a class of visitors, several each; all must stay open.
a_class_has_room() { # HOST
    in_machine python3 - "$1" 900 <<'END' || fail "there is no room for a class: $(in_machine tail -n 5 /var/log/nginx/error.log /var/log/apache2/error.log 2>&1)"
import resource, socket, ssl, sys

host, count = sys.argv[1], int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_NOFILE, (count + 100, count + 100))
context, doors = ssl.create_default_context(), []
asked = (f"GET /session HTTP/1.1\r\nHost: {host}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
         "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n")
for number in range(count):
    door = context.wrap_socket(socket.create_connection((host, 443), timeout=60), server_hostname=host)
    door.sendall(asked.encode())
    answer = door.recv(100)
    if b" 101 " not in answer:
        sys.exit(f"WebSocket {number}: {answer!r}")
    doors.append(door)
END
}

# A visit with a browser of this machine.
visit() { # HOST
    in_machine cat /etc/hosts >"$WORK/hosts"
    # shellcheck disable=SC2016
    nsenter --target "${inits[$here]}" --net unshare --mount sh -c '
        mount --bind "$1" /etc/hosts
        shift
        exec env PYTHONDONTWRITEBYTECODE=1 "$@"' visit "$WORK/hosts" "$BROWSER" tests/browser/through_web_server.py "https://$1/viewer" \
        >"$WORK/visit.log" 2>&1 || fail "$here: $(tail -n 30 "$WORK/visit.log")"
}

# Steps 1 to 5.
up_to_the_servers() { # HOST FILTER...
    local host=$1
    shift
    { commands '1. The programs' 2 && commands '2. Webots' && commands 'A virtual display for each simulation' &&
        commands '4. The configuration' | "$@"; } | follow "$host"
    ! grep 'warning: \|unknown key' "$WORK/guide.log" || fail 'the configuration in the guide has faults'
    grep --quiet 'display: each Webots gets a virtual display' "$WORK/guide.log" || fail 'the check does not tell of the display'
    adapt
    commands '5. Started at boot' | "$@" | follow "$host"
}

# All of the guide's steps on one machine.
one_machine() { # MACHINE HEADING OF THE WEB SERVER
    fresh "$1" "$FRONT"
    up_to_the_servers fleet.lab.example cat
    commands '6. The web server' | follow fleet.lab.example
    commands "$2" | follow fleet.lab.example
    eventually page https://fleet.lab.example/request '^1$'
    commands '7. Look' 1 | follow fleet.lab.example
    [[ $(tail -n 1 "$WORK/guide.log") == 1 ]] || fail "$(<"$WORK/guide.log")"
    page https://fleet.lab.example/monitor https://fleet.lab.example/2000/monitor || fail '/monitor is not there'
    page https://fleet.lab.example/2000/monitor html || fail '/2000/monitor is not there'
    page https://fleet.lab.example/1999/monitor html || fail 'what mails link to is not there'
    [[ $(status_of http://fleet.lab.example/monitor) == 301 ]] || fail 'http is not sent on to https'
    [[ $(status_of https://www.fleet.lab.example/monitor) == 301 ]] || fail 'www is not sent on'
    visit fleet.lab.example
    ended_with_all_it_had
    a_class_has_room fleet.lab.example
    only_the_fleet_is_reachable fleet.lab.example
}

# After a simulation neither Webots nor its display is left.
ended_with_all_it_had() {
    eventually no_simulation_runs
}

no_simulation_runs() {
    ! runs 'demo-simulator|Xvfb' && [[ -z $(in_machine find /tmp/.X11-unix -type s) ]]
}

# As after a reboot: runs only what is started at boot.
comes_back() {
    in_machine systemctl stop 'webots-*' 'nginx*' 'apache2*'
    ! page https://fleet.lab.example/monitor html 2>/dev/null || fail 'something runs'
    in_machine systemctl start multi-user.target
    eventually page https://fleet.lab.example/request '^1$'
}

# The guide's upgrade, while a simulation runs.
upgrade() {
    local old length
    simulate https://github.com/your-lab/arm/blob/main/worlds/arm.wbt &
    eventually grep --quiet --text 'webots:wss://fleet.lab.example/2000/stream/' "$WORK/client.log"
    in_machine sh -c 'rm ~lab/webots-fleet/target/debian/* && cp /mnt/packages/2.deb ~lab/webots-fleet/target/debian/webots-fleet_2.deb'
    old=$(property webots-simulation@main MainPID)
    length=$(stat --format=%s "$WORK/client.log")
    commands Upgrades 2 | follow fleet.lab.example
    [[ $(in_machine dpkg-query --show webots-fleet) == *999.0.0-2 ]] || fail 'it is not upgraded'
    eventually is_another webots-simulation@main "$old"
    is_later "/proc/$(property webots-simulation@main MainPID)/exe" || fail 'the old version runs on'
    ! is_later "/proc/$old/exe" || fail 'the simulation runs with the new version already'
    is_later "/proc/$(property webots-session@main MainPID)/exe" || fail 'the old session server runs on'
    eventually page https://fleet.lab.example/request '^1$'
    eventually hears_more "$length"
    eventually hears_more "$(stat --format=%s "$WORK/client.log")"
    leave
    eventually in_machine test ! -e "/proc/$old"
    in_machine grep --quiet gitMirrors /etc/webots-fleet/simulation/main.json || fail 'the configuration is lost'
    eventually page https://fleet.lab.example/request '^1$'
    visit fleet.lab.example
}

cable() { # MACHINE MACHINE
    local name
    for name in "$1" "$2"; do nsenter --target "${inits[$name]}" --net ip address flush dev lo scope global; done
    setpriv --pdeathsig KILL python3 tests/deploy/cable.py "${inits[$1]}" "$FRONT/24" "${inits[$2]}" "$FURTHER/24" >"$WORK/cable.log" 2>&1 &
    eventually grep connected "$WORK/cable.log"
}

# Drains the first machine with the guide's commands, so that visitors are sent to the other.
visit_the_other() { # PORT ITS MACHINE
    local first=$here
    eventually knows_both
    commands Upgrades 3 | follow fleet.lab.example
    eventually page https://fleet.lab.example/status '"down"'
    visit fleet.lab.example
    here=$2
    in_machine grep --quiet "port $1: ready" /var/log/webots-simulation/simulation/output.log || fail 'the simulation was elsewhere'
    ended_with_all_it_had
    here=$first
}

knows_both() {
    [[ $(in_machine curl --silent --fail --max-time 3 https://fleet.lab.example/metrics | grep --count '^webots_session_server_up{.*} 1') == 2 ]]
}

step() { # WORDS
    printf '%3s s  %s\n' "$SECONDS" "$1"
}

with_nginx() {
    step 'one machine with nginx'
    one_machine nginx nginx
    in_machine /usr/local/bin/certbot renew
    page https://fleet.lab.example/monitor html || fail 'a renewed certificate is not used'
    step 'nginx: everything is started at boot'
    comes_back
    step 'nginx: a running simulation survives an upgrade'
    upgrade

    step 'nginx: a further machine with a web server of its own, Apache'
    fresh gpu2 "$FURTHER"
    cable nginx gpu2
    up_to_the_servers gpu2.lab.example for_simulations_only
    { commands '6. The web server' && commands Apache; } | follow gpu2.lab.example
    here=nginx
    commands 'A web server on each' | sed 's/gpu2.example.org/gpu2.lab.example/' | follow fleet.lab.example
    visit_the_other 2001 gpu2
    ! firewall_lets_in "$FURTHER" gpu2 2010 || fail "everybody reaches Webots"
    step 'nginx: ok'
}

with_apache() {
    step 'one machine with Apache'
    one_machine apache Apache
    in_machine /usr/local/bin/certbot renew
    page https://fleet.lab.example/monitor html || fail 'a renewed certificate is not used'

    step 'Apache: a further machine behind it'
    fresh behind "$FURTHER"
    cable apache behind
    { commands '1. The programs' 2 && commands '2. Webots' && commands 'A virtual display for each simulation' &&
        commands 'One web server in front of all' 1; } | follow fleet.lab.example
    adapt
    in_machine systemctl restart webots-simulation@main
    here=apache
    { commands 'One web server in front of all' 3 && commands 'One web server in front of all' 4; } | follow fleet.lab.example
    visit_the_other 3001 behind
    firewall_lets_in "$FURTHER" behind 3010 || fail 'the web server does not reach Webots'
    ! firewall_lets_in "$FURTHER" behind 2010 || fail "what is no part of the fleet is reachable"
    step 'Apache: ok'
}

both() {
    local parts=() part result=0
    for part in nginx apache; do
        "$SCRIPT" "$part" &
        parts+=($!)
    done
    for part in "${parts[@]}"; do wait "$part" || result=$?; done
    exit "$result"
}

[[ -n $PART ]] || both
prepare
[[ -x $BROWSER && -e ${CHROMIUM:-/usr/bin/chromium} ]] || skip 'there is no browser: tests/python.sh, and apt install chromium'
make_stand_ins
"with_$PART"
