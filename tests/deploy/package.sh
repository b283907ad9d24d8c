#!/usr/bin/env bash
# Installs, runs, upgrades, removes and purges the Debian package in a clean Debian whose systemd runs the servers.
# tests/deploy/machine.sh tells what such a Debian is, and which variables count.
# shellcheck source=tests/deploy/machine.sh
. "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/machine.sh"

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

# What a user with a session of its own does.
as_lab() { # COMMAND...
    in_machine runuser -u lab -- env HOME=/home/lab XDG_RUNTIME_DIR="/run/user/$(in_machine id -u lab)" "$@"
}

main() {
    prepare
    boot machine

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
    make_project /srv/webots-demo/project worlds/a.wbt
    in_machine sed -i 's|"webotsHome": .*|"webots": "/usr/bin/demo-simulator", "gitMirrors": {"https://github.com/cyberbotics/demo": "file:/srv/webots-demo/project"},|; s|"xvfb": true|"xvfb": false|' \
        /etc/webots-fleet/simulation/main.json
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
    simulate https://github.com/cyberbotics/demo/blob/main/worlds/a.wbt &
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
    runs demo-simulator || fail 'the simulation is gone'
    eventually hears_more "$(stat --format=%s "$WORK/client.log")"

    echo 'renews the simulation server when its last simulation has ended'
    in_machine webots-fleet-renew main >"$WORK/renew.log" &
    local renewal=$!
    eventually drains webots-simulation@main
    sleep 2
    runs demo-simulator || fail 'the simulation was lost'
    eventually hears_more "$(stat --format=%s "$WORK/client.log")"
    leave
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

    echo 'runs as units of a user, started with the session of the user'
    in_machine systemctl stop 'webots-*'
    in_machine useradd --create-home --shell /bin/bash lab
    in_machine loginctl enable-linger lab
    eventually as_lab systemctl --user is-active default.target
    commands 'Units of a user' >"$WORK/packages/commands"
    sed -i '/^systemctl/d' "$WORK/packages/commands"
    as_lab bash -euo pipefail /mnt/packages/commands
    as_lab sed -i 's|"webotsHome": .*|"webots": "/usr/bin/demo-simulator", "gitMirrors": {"https://github.com/cyberbotics/demo": "file:/srv/webots-demo/project"},|; s|"xvfb": true|"xvfb": false|' \
        /home/lab/.config/webots-fleet/simulation/main.json
    commands 'Units of a user' | sed -n '/^systemctl/p' >"$WORK/packages/commands"
    as_lab bash -euo pipefail /mnt/packages/commands 2>/dev/null || fail "$(as_lab systemctl --user status 'webots-*' 2>&1)"
    eventually answers 1999 /status '"state":"\(up\|full\)"'
    simulate https://github.com/cyberbotics/demo/blob/main/worlds/a.wbt &
    eventually runs demo-simulator
    leave
    as_lab test -s /home/lab/.cache/webots-fleet/log/simulation/output.log || fail 'the log is elsewhere'
    # shellcheck disable=SC2016
    in_machine sh -c 'for process in $(pidof session-server simulation-server); do grep --quiet "^Seccomp:.2" /proc/$process/status || exit 1; done' ||
        fail 'they may do everything'
    as_lab systemctl --user disable --quiet --now 'webots-simulation@main' 'webots-session@main'

    echo 'is removed: nothing runs, configurations stay'
    in_machine apt-get remove --yes --quiet webots-fleet >"$WORK/remove.log" 2>&1 || fail "$(<"$WORK/remove.log")"
    ! runs 'session-server|simulation-serv' || fail 'a server still runs'
    in_machine test -e /etc/webots-fleet/simulation/main.json || fail 'the configuration is gone'

    echo 'is purged: nothing is left'
    in_machine userdel --force --remove lab 2>/dev/null
    in_machine rm -rf /run/systemd/system/webots-simulation@.service.d /srv/webots-demo
    in_machine dpkg --purge webots-fleet >"$WORK/purge.log" 2>&1 || fail "$(<"$WORK/purge.log")"
    [[ -z $(traces) ]] || fail "this is left: $(traces)"
    echo 'ok'
}

main
