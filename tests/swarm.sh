#!/usr/bin/env bash
# A fleet on a real Docker Swarm on this machine, by deploy/swarm/stack.yml and the images of deploy/docker: deploy, grow, shrink,
# update, kill. Says what it measures.
#
# dockerd runs in namespaces of its own, from which nothing can be reached. So the images that the Dockerfile begins with are
# a Debian that debootstrap makes, kept in target/deploy, with an apt-get that has nothing to do and a cargo that copies what is built
# already: FLEET_BIN, an absolute path, names its folder.
set -Eeuo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
PATH=$PATH:/usr/sbin:/sbin

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

# Where this can't be tested it has not passed: it ends with 77, as skipped tests do; where everything has to be tested
# (CI is set) it has failed.
skip() { # WHY
    [[ -z ${CI-} ]] || fail "this has to be tested where CI is set, and can't: $*"
    printf 'skipped: swarm.sh: %s\n' "$*" >&2
    exit 77
}

((EUID == 0)) || skip 'dockerd needs root'
for program in dockerd docker debootstrap unshare nsenter ip iptables python3; do
    command -v "$program" >/dev/null || skip "there is no $program"
done
# shellcheck disable=SC1091
DISTRIBUTION=$(. /etc/os-release && echo "${VERSION_CODENAME-}")
readonly DISTRIBUTION BIN=${FLEET_BIN:-$PWD/target/debug} ROOT=$PWD/target/deploy/swarm-$DISTRIBUTION
readonly WORLD=https://github.com/webots-fleet/demo/blob/main/worlds/playground.wbt
readonly DOOR=http://127.0.0.1:8080
[[ -x $BIN/session-server && -x $BIN/rehearse ]] || fail "there are no programs in $BIN: cargo build"
WORK=$(mktemp -d)
readonly WORK
export DOCKER_HOST=unix://$WORK/docker.sock DOCKER_CONFIG=$WORK DOCKER_BUILDKIT=0
readonly GROUP=webots-fleet-swarm.$$
machine='' keeper=''

finish() {
    local code=$?
    trap - EXIT
    if ((code != 0)) && [[ -S $WORK/docker.sock ]]; then
        timeout 10 docker service ps --no-trunc fleet_door fleet_session fleet_simulation >&2 || true
        for service in door session simulation; do timeout 10 docker service logs --tail 20 "fleet_$service" >&2 || true; done
    fi
    # With it the first process of its namespace ends, and with that all the others.
    [[ -z $keeper ]] || kill -KILL "$keeper" 2>/dev/null || true
    wait 2>/dev/null || true
    local patience=50
    until find /sys/fs/cgroup -depth -type d -path "*/$GROUP*" -exec rmdir {} + 2>/dev/null || ((patience-- == 0)); do sleep 0.1; done
    rm -rf "$WORK"
    exit "$code"
}
trap 'printf "error: line %s: %s\n" "$LINENO" "$BASH_COMMAND" >&2' ERR
trap finish EXIT
trap 'exit 130' INT TERM HUP

# Milliseconds since the machine was started.
now() {
    local uptime
    read -r uptime _ </proc/uptime
    echo "${uptime/./}0"
}

# Waits until a command succeeds; fails after so many seconds.
within() { # SECONDS COMMAND...
    local begin limit=$1
    begin=$(now)
    shift
    until "$@" >/dev/null 2>&1; do
        (($(now) - begin < limit * 1000)) || fail "not within $limit s: $*"
        sleep 0.1
    done
}

in_machine() {
    nsenter --target "$machine" --net -- "$@"
}

get() { # PATH
    in_machine curl --silent --show-error --max-time 5 "$DOOR$1"
}

# Where simulation servers are, of those in these states.
servers() { # STATE...
    get /status | python3 -c 'import json, sys
print(*(one["address"] for one in json.load(sys.stdin)["servers"] if one["state"] in sys.argv[1:]))' "$@"
}

are() { # NUMBER STATE...
    local found
    found=$(servers "${@:2}") && [[ $(wc -w <<<"$found") == "$1" ]]
}

containers() { # SERVICE
    docker ps --quiet --filter "label=com.docker.swarm.service.name=fleet_$1"
}

run_containers() { # NUMBER SERVICE
    [[ $(containers "$2" | wc -l) == "$1" ]]
}

# Whether Swarm uses so many: it does once they were healthy for the first time.
are_healthy() { # NUMBER SERVICE
    [[ $(docker ps --quiet --filter "label=com.docker.swarm.service.name=fleet_$2" --filter health=healthy | wc -l) == "$1" ]]
}

# A class of clients that come and go; each has to be there to the end.
class() { # CLIENTS OVER STAY
    in_machine "$BIN/rehearse" --yes --world "$WORLD" --clients "$1" --over "$2" --stay "$3" --real-time 0.01 --expect "$1" \
        "$DOOR" >"$WORK/class" 2>&1 || fail "$(cat "$WORK/class")"
}

build() { # IMAGE ARGUMENT...
    docker build --quiet --tag "$@" >"$WORK/build" 2>&1 || fail "$(cat "$WORK/build")"
}

told() {
    printf '%-64s %s\n' "$1" "$2"
}

# --- The Debian of all images.

if [[ ! -e $ROOT/.complete ]]; then
    rm -rf "$ROOT"
    mkdir -p "${ROOT%/*}"
    debootstrap --variant=minbase --include=ca-certificates,curl,git,tini,nginx-light "$DISTRIBUTION" "$ROOT" \
        "${FLEET_MIRROR:-http://deb.debian.org/debian}" >"$WORK/debootstrap" 2>&1 ||
        skip "no Debian can be made here: $(tail -n 1 "$WORK/debootstrap")"
    rm -rf "$ROOT/var/cache/apt/archives"
    touch "$ROOT/.complete"
fi

# --- A machine with dockerd, which ends with this script.

mkdir -p "$WORK/data"
# shellcheck disable=SC2016 # It is the inner shell's.
unshare --net --mount --pid --fork --kill-child --mount-proc --propagation private bash -c '
    ip link set lo up
    ip link add v0 type veth peer name v1
    ip address add 10.99.0.1/24 dev v0
    ip link set v0 up
    ip link set v1 up
    mount -t tmpfs tmpfs /run
    exec dockerd --data-root "$0/data" --exec-root /run/docker --pidfile /run/docker.pid --host "unix://$0/docker.sock" --cgroup-parent "/$1"
' "$WORK" "$GROUP" >"$WORK/dockerd" 2>&1 &
keeper=$!
for ((tries = 0; tries < 150; tries++)); do
    machine=$(pgrep --parent "$keeper" || true)
    docker info >/dev/null 2>&1 && break
    sleep 0.2
done
docker info >/dev/null 2>&1 || skip "dockerd does not run here: $(tail -n 1 "$WORK/dockerd")"
docker swarm init --advertise-addr 10.99.0.1 >/dev/null
docker node update --label-add webots-fleet.door=true "$(docker node ls --quiet)" >/dev/null

# --- The images.

mkdir "$WORK/base"
printf '#!/bin/sh\n' >"$WORK/base/apt-get"
printf '#!/bin/sh\nmkdir -p target/release\ncp /programs/* target/release/\n' >"$WORK/base/cargo"
cp "$BIN"/{session-server,simulation-server,demo-simulator} "$WORK/base"
strip "$WORK"/base/*-server "$WORK/base/demo-simulator" 2>/dev/null || true
chmod +x "$WORK"/base/*
tar --directory "$ROOT" --create . | docker import - debian:bookworm-slim >/dev/null
cat >"$WORK/base/Dockerfile" <<'END'
FROM debian:bookworm-slim
COPY apt-get cargo /usr/local/bin/
COPY *-server demo-simulator /programs/
END
build fleet-base "$WORK/base"
for image in debian:bookworm-slim rust:1.95-bullseye cyberbotics/webots:R2025a-ubuntu22.04; do docker tag fleet-base "$image"; done
for image in session-server simulation-demo simulation-server; do
    build "webots-fleet/$image:0.1.0" --file deploy/docker/Dockerfile --target "$image" .
done
# nginx as its unprivileged image has it.
mkdir "$WORK/nginx"
cat >"$WORK/nginx/nginx.conf" <<'END'
pid /tmp/nginx.pid;
error_log /dev/stderr warn;
events { worker_connections 1024; }
http {
  client_body_temp_path /tmp/client_body; proxy_temp_path /tmp/proxy; fastcgi_temp_path /tmp/fastcgi;
  uwsgi_temp_path /tmp/uwsgi; scgi_temp_path /tmp/scgi;
  access_log off;
  include /etc/nginx/conf.d/*.conf;
}
END
cat >"$WORK/nginx/Dockerfile" <<'END'
FROM debian:bookworm-slim
COPY nginx.conf /etc/nginx/nginx.conf
USER 101:101
STOPSIGNAL SIGQUIT
CMD ["nginx", "-g", "daemon off;"]
END
build nginxinc/nginx-unprivileged:1.28 "$WORK/nginx"

# --- The fleet.

cp --recursive deploy/swarm "$WORK/swarm"
# This machine is busy with other tests, and its load says nothing.
sed -i 's/"port": 1999,/"port": 1999,\n  "loadThreshold": 1000,/' "$WORK/swarm/session.json"
begin=$(now)
docker stack deploy --compose-file "$WORK/swarm/stack.yml" fleet >/dev/null 2>&1
available() { [[ $(get /request) == 1 ]]; }
within 60 available
class 1 0s 1s
told 'from docker stack deploy to the end of the first simulation' "$(($(now) - begin)) ms"
within 20 are 2 up

# Four more while clients come and go.
class 20 8s 8s &
clients=$!
sleep 1
begin=$(now)
docker service scale --detach fleet_simulation=6 >/dev/null
within 60 run_containers 6 simulation
started=$(now)
within 5 are 6 up
told 'from docker service scale 2 -> 6 until all six run' "$((started - begin)) ms"
told 'from then until the session server offers all six' "$(($(now) - started)) ms"
wait "$clients"

# Four fewer while simulations run: each of these goes on to its end.
class 20 1s 10s &
clients=$!
sleep 4
begin=$(now)
docker service scale --detach fleet_simulation=2 >/dev/null
within 5 are 2 up
told 'from docker service scale 6 -> 2 until two are offered' "$(($(now) - begin)) ms"
staying=$(servers up)
for ((number = 0; number < 20; number++)); do
    given=$(get /session) && given=${given#ws://localhost:8080/}
    [[ " $staying " == *" ${given/\//:} "* ]] || fail "a client was sent to $given, which leaves; these stay: $staying"
done
wait "$clients"
told 'clients of the leaving servers, and of the others, to the end' '20 of 20'
within 30 run_containers 2 simulation

# Every server is replaced while simulations run.
before=$(containers simulation)
class 20 1s 10s &
clients=$!
sleep 3
docker service update --detach --force fleet_simulation >/dev/null
wait "$clients"
replaced() {
    local one after
    after=$(containers simulation)
    [[ $(wc -w <<<"$after") == 2 ]] || return
    for one in $before; do [[ " ${after//$'\n'/ } " != *" $one "* ]] || return; done
}
within 90 replaced
within 10 are 2 up
told 'clients during a rolling update, to the end' '20 of 20'

# What is killed comes back.
killed=$(containers simulation | head -n 1)
begin=$(now)
docker kill "$killed" >/dev/null
available || fail 'the other server is there'
whole() { are_healthy 2 simulation && are 2 up && are 0 down; }
within 30 whole
told 'from docker kill of a simulation server until two are offered' "$(($(now) - begin)) ms"
class 10 0s 10s &
clients=$!
sleep 2
for session in $(containers session); do
    docker kill "$session" >/dev/null
    within 2 available
    within 30 are_healthy 2 session
done
wait "$clients"
told 'clients while both session servers are killed in turn, to the end' '10 of 10'

# The door leads to the fleet, and nowhere else.
inside=$(servers up | cut -d ' ' -f 1)
session=$(docker inspect --format '{{(index .NetworkSettings.Networks "fleet_fleet").IPAddress}}' "$(containers session | head -n 1)")
[[ $(get "/${inside/://}/load") =~ ^[0-9.]+$ ]] || fail 'the door does not lead to a simulation server'
for path in /127.0.0.1/2000/load /10.99.0.1/2000/load /localhost/2000/load /simulation/2000/load /172.18.0.1/2000/load \
    "/$session/1999/status" "/${inside%:*}/22/" "/${inside%:*}/2021/" "/${inside%:*}/2000/drain" "/%0a${inside%:*}/2000/load"; do
    code=$(get "$path" --output /dev/null 2>/dev/null | grep --only-matching '404 Not Found' | head -n 1 || true)
    [[ $code == '404 Not Found' ]] || fail "the door leads to $path"
done
told 'paths to elsewhere that the door refuses' '10 of 10'
docker stack rm fleet >/dev/null
echo passed
