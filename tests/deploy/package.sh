#!/usr/bin/env bash
# Installs, runs, upgrades, removes and purges the Debian package in a clean Debian whose systemd runs the servers.
# tests/deploy/machine.sh describes this Debian and the environment variables.
# shellcheck source=tests/deploy/machine.sh
. "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/machine.sh"

# Every file and user of the machine that belongs to the package.
traces() {
    in_machine sh -c 'find / -xdev \( -name "*webots*" -o -name "*simulation-server*" -o -name "*session-server*" \) \
        -not -path "/mnt/*" -not -path "/proc/*" -not -path "/sys/*"; getent passwd | grep webots || true'
}

install_package() { # REVISION OPTION...
    local revision=$1
    shift
    in_machine apt-get install --yes --quiet --no-install-recommends "$@" "/mnt/packages/$revision.deb" 2>&1
}

nothing_runs() {
    ! runs 'session-server|simulation-serv'
}

# Whether the containers' packet filter is loaded.
filters() {
    in_machine nft list table inet webots_fleet >/dev/null 2>&1
}

# How many processes of the simulation server have control groups for their simulations.
control_groups() {
    in_machine grep --count 'each simulation gets a control group' /var/log/webots-simulation/simulation/output.log || true
}

user_property() { # UNIT NAME
    as_lab systemctl --user show --property="$2" --value "$1"
}

# Runs a command as a user with a login session.
as_lab() { # COMMAND...
    in_machine runuser -u lab -- env HOME=/home/lab XDG_RUNTIME_DIR="/run/user/$(in_machine id -u lab)" "$@"
}

# Starts another unit that runs a program of the package: needrestart does restart such units.
spared_by_needrestart_begins() {
    # shellcheck disable=SC2016
    in_machine sh -c '
        set -e
        apt-get install --yes --quiet --no-install-recommends needrestart
        sed "s/1999/1998/; /logDir/d; s/\],$/]/" /etc/webots-fleet/session/main.json >/srv/other.json
        printf "[Service]\nType=exec\nExecStart=/usr/bin/session-server /srv/other.json\nWorkingDirectory=/run\n" >/etc/systemd/system/other.service
        systemctl start other' >"$WORK/needrestart.log" 2>&1 || fail "$(<"$WORK/needrestart.log")"
    eventually answers 1998 /health ok
}

spared_by_needrestart_ends() { # PID OF THE SIMULATION SERVER
    in_machine needrestart -l -r a >"$WORK/needrestart.log" 2>&1 || fail "$(<"$WORK/needrestart.log")"
    is_later "/proc/$(property other MainPID)/exe" || fail "needrestart restarts nothing: $(<"$WORK/needrestart.log")"
    [[ $(property webots-simulation@main MainPID) == "$1" ]] || fail 'needrestart has ended simulations'
    in_machine systemctl stop other
    in_machine rm -f /etc/systemd/system/other.service /srv/other.json
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
    # The client of `simulate` answers no ping, and opens no stream.
    in_machine sed -i 's|"webotsHome": .*|"webots": "/usr/bin/demo-simulator", "timing": {"arrival": 0, "silence": 3600}, "gitMirrors": {"https://github.com/cyberbotics/demo": "file:/srv/webots-demo/project"},|; s|"xvfb": true|"xvfb": false|' \
        /etc/webots-fleet/simulation/main.json
    in_machine systemctl enable --quiet webots-session@main webots-simulation@main
    # As at boot.
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

    echo 'loads the packet filter of containers where there is nft'
    [[ $(property webots-fleet-packet-filter ActiveState) == inactive ]] || fail 'it is loaded without nft'
    ! in_machine systemctl is-failed --quiet webots-fleet-packet-filter || fail 'it fails without nft'
    in_machine apt-get install --yes --quiet --no-install-recommends nftables >"$WORK/install.log" 2>&1 || fail "$(<"$WORK/install.log")"
    in_machine systemd-analyze verify webots-fleet-packet-filter.service || fail 'systemd finds faults in the packet filter'
    in_machine systemctl enable --quiet --now nftables webots-fleet-packet-filter
    filters || fail 'it is not loaded'
    # Both flush all rules first.
    in_machine systemctl reload nftables
    eventually filters
    in_machine systemctl restart nftables
    eventually filters

    echo 'runs a simulation within the limits of the unit'
    simulate https://github.com/cyberbotics/demo/blob/main/worlds/a.wbt &
    eventually runs demo-simulator
    eventually grep --quiet --text 'webots:ws://localhost:2000/stream/' "$WORK/client.log"

    echo 'reloads, and comes back after a crash'
    in_machine sed -i 's/"localhost:2000"/"localhost:2000", "localhost:2200"/' /etc/webots-fleet/session/main.json
    in_machine systemctl reload webots-session@main
    eventually answers 1999 /status 2200
    in_machine cp /etc/webots-fleet/session/main.json /srv/good.json
    in_machine sed -i 's/"port": 1999/"port": "many"/; s/, "localhost:2200"//' /etc/webots-fleet/session/main.json
    ! in_machine systemctl reload webots-session@main 2>"$WORK/reload.log" || fail 'a reload of a wrong configuration succeeds'
    grep --quiet 'webots-session@main.service failed' "$WORK/reload.log" || fail "$(<"$WORK/reload.log")"
    in_machine journalctl --sync
    grep --quiet 'main.json.*port' <<<"$(in_machine journalctl --unit=webots-session@main --output=cat)" || fail 'nobody is told what is wrong'
    answers 1999 /status 2200 || fail 'it does not go on as before'
    in_machine mv /srv/good.json /etc/webots-fleet/session/main.json
    in_machine chmod 644 /etc/webots-fleet/session/main.json
    in_machine systemctl reload webots-session@main
    local old
    old=$(property webots-session@main MainPID)
    in_machine sh -c "kill -KILL $old"
    eventually answers 1999 /health ok
    eventually is_another webots-session@main "$old"

    echo 'upgrades: configurations are kept, simulations run on'
    in_machine sed -i 's/"maxConnections": 20/"maxConnections": 7/' /etc/webots-fleet/simulation/main.json
    old=$(property webots-simulation@main MainPID)
    local old_session groups
    groups=$(control_groups)
    ((groups > 0)) || fail 'simulations have no control groups'
    old_session=$(property webots-session@main MainPID)
    spared_by_needrestart_begins
    install_package 2 -o Dpkg::Options::=--force-confold >"$WORK/install.log" || fail "$(<"$WORK/install.log")"
    [[ $(in_machine dpkg-query --show webots-fleet) == *999.0.0-2 ]] || fail 'it is not upgraded'
    is_later /usr/share/webots-fleet/nginx.conf || fail 'the examples are the old ones'
    in_machine grep --quiet '"maxConnections": 19' /etc/webots-fleet/simulation/main.json.dpkg-dist || fail 'the new example is not there'
    grep --quiet 'webots-simulation@main.service runs anew' "$WORK/install.log" || fail "$(<"$WORK/install.log")"
    in_machine grep --quiet '"maxConnections": 7' /etc/webots-fleet/simulation/main.json || fail 'the configuration is lost'
    local new
    new=$(property webots-simulation@main MainPID)
    [[ $new != "$old" ]] || fail 'the simulation server has not handed over'
    is_later "/proc/$new/exe" || fail 'it is the old program'
    (($(control_groups) == groups + 1)) || fail 'the simulations of the new process have no control groups'
    [[ $(property webots-session@main MainPID) != "$old_session" ]] || fail 'the session server was not restarted'
    is_later "/proc/$(property webots-session@main MainPID)/exe" || fail 'the session server is the old one'
    ! is_later "/proc/$old/exe" || fail 'the packages do not differ'
    spared_by_needrestart_ends "$new"
    filters || fail 'the packet filter is gone'
    runs demo-simulator || fail 'the simulation is gone'
    eventually hears_more "$(stat --format=%s "$WORK/client.log")"

    echo 'serves the simulation by the old process until its client leaves, and others by the new one'
    answers 2000 /status '"places":7' || fail 'it has not read its configuration'
    answers 2000 /status '"stage":"\(idle\|running\)"' || fail 'the simulation is not shown'
    # A machine that is busy otherwise makes it full.
    eventually answers 1999 /status '"state":"\(up\|full\)"'
    in_machine webots-fleet-renew main >"$WORK/renew.log" 2>&1 || fail "it was not renewed: $(<"$WORK/renew.log")"
    eventually is_another webots-simulation@main "$new"
    eventually hears_more "$(stat --format=%s "$WORK/client.log")"
    in_machine test -e "/proc/$old" || fail 'the old process has ended before its client'
    leave
    eventually in_machine test ! -e "/proc/$old"
    [[ $(property webots-simulation@main ActiveState) == active ]] || fail 'the server has ended with its old process'

    echo 'ends all its processes when it is stopped'
    simulate https://github.com/cyberbotics/demo/blob/main/worlds/a.wbt &
    eventually runs demo-simulator
    old=$(property webots-simulation@main MainPID)
    in_machine systemctl reload webots-simulation@main
    eventually is_another webots-simulation@main "$old"
    in_machine test -e "/proc/$old" || fail 'the old process has ended'
    in_machine systemctl stop webots-simulation@main
    eventually in_machine test ! -e "/proc/$old"
    ! runs demo-simulator || fail 'a simulation lives on'
    in_machine systemctl start webots-simulation@main

    echo 'renews nothing whose configuration is wrong'
    old=$(property webots-simulation@main MainPID)
    in_machine sed -i.good 's/"port": 2000/"port": "many"/' /etc/webots-fleet/simulation/main.json
    ! in_machine webots-fleet-renew >"$WORK/renew.log" 2>&1 || fail 'a wrong configuration is taken'
    grep --quiet 'main.json: port' "$WORK/renew.log" || fail "$(<"$WORK/renew.log")"
    grep --quiet "webots-simulation@main.service runs on as it was" "$WORK/renew.log" || fail "$(<"$WORK/renew.log")"
    in_machine mv /etc/webots-fleet/simulation/main.json.good /etc/webots-fleet/simulation/main.json
    [[ $(property webots-simulation@main MainPID) == "$old" ]] || fail 'it was drained, and has ended'
    ! drains || fail 'it drains'

    echo 'does not try again with a wrong configuration'
    in_machine sh -c 'echo "{}" >/etc/webots-fleet/session/wrong.json'
    ! in_machine systemctl start webots-session@wrong 2>/dev/null || fail 'a wrong configuration is used'
    sleep 3
    [[ $(property webots-session@wrong NRestarts) == 0 ]] || fail 'it was tried again'
    [[ $(property webots-session@wrong ExecMainStatus) == 2 ]] || fail 'the exit code is another'

    echo 'is started again when it hangs'
    old=$(property webots-simulation@main MainPID)
    in_machine mkdir -p /run/systemd/system/webots-simulation@.service.d
    in_machine sh -c 'printf "[Service]\nWatchdogSec=8\n" >/run/systemd/system/webots-simulation@.service.d/test.conf'
    in_machine systemctl daemon-reload
    in_machine systemctl restart webots-simulation@main
    old=$(property webots-simulation@main MainPID)
    sleep 12
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
    # A target in place of a desktop session, to start the user's units.
    in_machine sh -c 'printf "[Unit]\nBindsTo=graphical-session.target\nBefore=graphical-session.target\n" >/etc/systemd/user/desktop.target'
    as_lab systemctl --user daemon-reload
    as_lab systemd-analyze --user verify webots-session@main.service webots-simulation@main.service || fail 'systemd finds faults in units of a user'
    as_lab bash -euo pipefail /mnt/packages/commands 2>/dev/null || fail "$(as_lab systemctl --user status 'webots-*' 2>&1)"
    eventually answers 1999 /status '"state":"\(up\|full\)"'
    simulate https://github.com/cyberbotics/demo/blob/main/worlds/a.wbt &
    eventually runs demo-simulator
    leave
    as_lab test -s /home/lab/.cache/webots-fleet/log/simulation/output.log || fail 'the log is elsewhere'
    # shellcheck disable=SC2016
    in_machine sh -c 'for process in $(pidof session-server simulation-server); do grep --quiet "^Seccomp:.2" /proc/$process/status 2>/dev/null || [ ! -e /proc/$process ] || exit 1; done' ||
        fail 'they may do everything'
    as_lab systemctl --user stop 'webots-*'
    for _ in 1 2; do
        as_lab systemctl --user start desktop.target
        eventually answers 1999 /health ok
        simulation=$(user_property webots-simulation@main ActiveEnterTimestampMonotonic)
        session=$(user_property webots-session@main InactiveExitTimestampMonotonic)
        ((simulation > 0 && simulation <= session)) || fail 'the session server of a user was started first'
        as_lab systemctl --user stop desktop.target
        eventually nothing_runs
    done
    as_lab systemctl --user start desktop.target
    eventually answers 1999 /health ok

    echo 'is removed: nothing runs, configurations stay'
    in_machine systemctl --quiet --global enable webots-simulation@lab
    in_machine mkdir -p /etc/systemd/system/webots-session@main.service.d /etc/systemd/user/webots-simulation@.service.d
    in_machine touch /etc/systemd/system/webots-session@main.service.d/override.conf /etc/systemd/user/webots-simulation@.service.d/override.conf
    in_machine systemctl --quiet mask webots-session@other
    in_machine sh -c 'sed s/1999/1998/ /etc/webots-fleet/session/main.json >/etc/webots-fleet/session/second.json'
    in_machine systemctl start webots-session@second
    in_machine apt-get remove --yes --quiet webots-fleet >"$WORK/remove.log" 2>&1 || fail "$(<"$WORK/remove.log")"
    nothing_runs || fail 'a server still runs'
    ! filters || fail 'the packet filter is still there'
    ! as_lab systemctl --user cat webots-session@new.service >/dev/null 2>&1 || fail "a user's manager still knows the units"
    in_machine test -e /etc/webots-fleet/simulation/main.json || fail 'the configuration is gone'

    echo 'is purged: nothing is left'
    in_machine test -L /home/lab/.config/systemd/user/graphical-session.target.wants/webots-session@main.service || fail 'what was enabled is elsewhere'
    in_machine userdel --force --remove lab 2>/dev/null
    in_machine rm -rf /run/systemd/system/webots-simulation@.service.d /srv/webots-demo
    in_machine dpkg --purge webots-fleet >"$WORK/purge.log" 2>&1 || fail "$(<"$WORK/purge.log")"
    in_machine rm /etc/systemd/user/desktop.target
    [[ -z $(traces) ]] || fail "this is left: $(traces)"

    echo "starts the demo from a release's archive, where nothing can be built"
    in_machine mkdir '/srv/a release'
    in_machine tar --extract --file=/mnt/packages/release.tar.gz --directory='/srv/a release' --strip-components=1
    in_machine '/srv/a release/server.sh' start demo >"$WORK/demo.log" 2>&1 || fail "$(<"$WORK/demo.log")"
    eventually answers 1999 /status '"state":"\(up\|full\)"'
    in_machine '/srv/a release/server.sh' stop >"$WORK/demo.log" 2>&1 || fail "$(<"$WORK/demo.log")"
    eventually nothing_runs
    echo 'ok'
}

main
