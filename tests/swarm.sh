#!/usr/bin/env bash
# A fleet on a real Docker Swarm on this machine, with deploy/swarm/stack.yml and the images of deploy/docker: deploy, grow, shrink,
# update, edit, kill; visits with Chromium. Prints what it measures.
#
# dockerd runs in its own namespaces, without a network to the outside. So the base images of the Dockerfile are the Debian of
# tests/image_root.sh, with an apt-get that does nothing and a cargo that copies the programs from FLEET_BIN, an absolute path.
# While the file FLEET_BUSY exists, the script only makes the images and measures nothing.
set -Eeuo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
PATH=$PATH:/usr/sbin:/sbin

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

# Ends with 77, as skipped tests do, if this machine can't run the test; if everything must be tested (CI is set), it fails.
skip() { # WHY
    [[ -z ${CI-} ]] || fail "this has to be tested where CI is set, and can't: $*"
    printf 'skipped: swarm.sh: %s\n' "$*" >&2
    exit 77
}

((EUID == 0)) || skip 'dockerd needs root'
for program in dockerd docker unshare nsenter ip iptables python3 openssl "${CHROMIUM:-chromium}"; do
    command -v "$program" >/dev/null || skip "there is no $program"
done
readonly BIN=${FLEET_BIN:-$PWD/target/debug} ROOT=target/tmp/images.tar
readonly WORLD=https://github.com/webots-fleet/demo/blob/main/worlds/playground.wbt
readonly DOOR=http://127.0.0.1:8080 VIEWER=http://localhost:8080/viewer
[[ -x $BIN/session-server && -x $BIN/rehearse ]] || fail "there are no programs in $BIN: cargo build"
tests/image_root.sh "$ROOT" || skip 'no Debian can be made here'
PYTHON=$(tests/python.sh)
readonly PYTHON
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
    # This ends the first process of its namespace, and so all others in it.
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

# Milliseconds since boot.
now() {
    local uptime
    read -r uptime _ </proc/uptime
    echo "${uptime/./}0"
}

# Waits until a command succeeds; fails after this many seconds.
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

# The addresses of the simulation servers in these states.
servers() { # STATE...
    get /status | python3 -c 'import json, sys
print(*(one["address"] for one in json.load(sys.stdin)["servers"] if one["state"] in sys.argv[1:]))' "$@"
}

# Checks /status, in Python: what is asked of one is asked of twelve answers, which are of both session servers, as the door
# forwards to either, and one may lag behind.
everywhere() { # CHECK ARGUMENT...
    local urls=()
    for _ in {1..12}; do urls+=("$DOOR/status"); done
    in_machine curl --silent --show-error --max-time 5 --write-out '\n' "${urls[@]}" | python3 -c "import json, sys
wanted, *states = sys.argv[1:]
answers = [json.loads(line)['servers'] for line in sys.stdin]
sys.exit(len(answers) != 12 or any(($1) != int(wanted) for servers in answers))" "${@:2}"
}

# Whether this many simulation servers are in these states.
are() { # NUMBER STATE...
    everywhere 'sum(one["state"] in states for one in servers)' "$@"
}

# Whether this many simulations run on all servers together.
run_simulations() { # NUMBER
    everywhere 'sum(one["instances"]["running"] for one in servers if one["instances"])' "$1"
}

containers() { # SERVICE...
    local service
    for service in "$@"; do docker ps --quiet --filter "label=com.docker.swarm.service.name=fleet_$service"; done
}

run_containers() { # NUMBER SERVICE
    [[ $(containers "$2" | wc -l) == "$1" ]]
}

# Whether this many are healthy; Swarm sends requests to a container once it is.
are_healthy() { # NUMBER SERVICE
    [[ $(docker ps --quiet --filter "label=com.docker.swarm.service.name=fleet_$2" --filter health=healthy | wc -l) == "$1" ]]
}

# A class of clients that come and go; each must stay to the end with a moving simulation (stays of 2 s are too short to measure
# that: their REAL_TIME is 0).
class() { # CLIENTS OVER STAY REAL_TIME ARGUMENT...
    in_machine "$BIN/rehearse" --yes --world "$WORLD" --clients "$1" --over "$2" --stay "$3" --real-time "$4" --expect "$1" \
        "${@:5}" "$DOOR" >"$WORK/class" 2>&1 || fail "$(cat "$WORK/class")"
}

# Starts a class whose clients all come at once, and returns when all their simulations run, so that a disturbance affects the whole
# class even on a slow machine. Waits first until the simulations of earlier classes have ended. Callers wait for $clients.
full_class() { # CLIENTS
    within 60 run_simulations 0
    class "$1" 1s 24s 0.01 &
    clients=$!
    within 60 run_simulations "$1"
}

# A visit with Chromium; its output is kept.
visit() { # URL ARGUMENT...
    in_machine "$PYTHON" tests/browser/through_swarm.py "$@" >"$WORK/visit" 2>"$WORK/visit-errors" ||
        fail "$(cat "$WORK/visit" "$WORK/visit-errors")"
}

# The time that the visit's output gives for this event.
said() { # WHAT
    sed --quiet "s/^$1 //p" "$WORK/visit"
}

has_said() { # WHAT
    [[ -n $(said "$1") ]]
}

build() { # IMAGE ARGUMENT...
    docker build --quiet --tag "$@" >"$WORK/build" 2>&1 || fail "$(cat "$WORK/build")"
}

# Runs a command that deploys; prints its errors if it fails.
deploy() { # COMMAND...
    "$@" >/dev/null 2>"$WORK/deploy" || fail "$(cat "$WORK/deploy")"
}

# A command of docs/scaling.md: the one of this number among the indented commands below a heading.
page() { # HEADING NUMBER
    local found
    found=$(awk -v heading="## $1" -v number="$2" '
        /^```/ { inside = !inside }
        /^#/ && !inside { wanted = $0 == heading }
        wanted && !inside && /^    / && ++count == number { print substr($0, 5) }' docs/scaling.md)
    [[ -n $found ]] || fail "docs/scaling.md has no command $2 below '$1'"
    printf '%s\n' "$found"
}

# Runs a command of the documentation in a folder.
follow() { # FOLDER COMMAND
    (cd "$1" && bash -euo pipefail -c "$2") >"$WORK/page" 2>&1 || fail "$2: $(tail -n 20 "$WORK/page")"
}

told() {
    printf '%-64s %s\n' "$1" "$2"
}

# --- A machine with dockerd. It ends with this script.

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
for ((tries = 0; tries < 300; tries++)); do
    machine=$(pgrep --parent "$keeper" || true)
    docker info >/dev/null 2>&1 && break
    sleep 0.2
done
docker info >/dev/null 2>&1 || skip "dockerd does not run here: $(tail -n 1 "$WORK/dockerd")"
follow . "$(page 'Docker Swarm' 1)"

# --- The images.

mkdir "$WORK/base"
printf '#!/bin/sh\n' >"$WORK/base/apt-get"
printf '#!/bin/sh\nmkdir -p target/dist\ncp /programs/* target/dist/\n' >"$WORK/base/cargo"
cp "$BIN"/{session-server,simulation-server,demo-simulator} "$WORK/base"
strip "$WORK"/base/*-server "$WORK/base/demo-simulator" 2>/dev/null || true
chmod +x "$WORK"/base/*
docker import "$ROOT" debian:bookworm-slim >/dev/null
cat >"$WORK/base/Dockerfile" <<'END'
FROM debian:bookworm-slim
COPY apt-get cargo /usr/local/bin/
COPY *-server demo-simulator /programs/
END
build fleet-base "$WORK/base"
for image in debian:bookworm-slim rust:1.95-bullseye cyberbotics/webots:R2025a-ubuntu22.04; do docker tag fleet-base "$image"; done
follow . "$(page 'Docker Swarm' 2)"
# The image with Webots, for a fleet that runs it.
follow . "$(page 'Docker Swarm' 6)"
# nginx as in its unprivileged image.
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
COPY default.conf /etc/nginx/conf.d/
CMD ["nginx", "-g", "daemon off;"]
END
printf 'server {\n  listen 8080;\n  server_name localhost;\n  location / { return 418; }\n}\n' >"$WORK/nginx/default.conf"
build nginxinc/nginx-unprivileged:1.28 "$WORK/nginx"

# --- The fleet.

until [[ ! -e ${FLEET_BUSY-} ]]; do sleep 0.1; done
mkdir -p "$WORK/project/deploy"
cp --recursive deploy/swarm "$WORK/project/deploy"
ln -s project/deploy/swarm "$WORK/swarm"
# All servers report the load of this one busy machine: it must not make them full, and each client counts for more.
sed -i 's/"port": 1999,/"port": 1999,\n  "loadThreshold": 1000,\n  "clientCost": 30,/' "$WORK/swarm/session.json"
begin=$(now)
follow "$WORK/project" "$(page 'Docker Swarm' 3)"
visit "$VIEWER"
told 'from docker stack deploy to a scene that moves in Chromium' "$(($(said moves) - begin)) ms"
within 20 are 2 up

# Four more servers while clients come and go, often enough to use each new server at once.
class 20 2s 2s 0 --soak 30s --json "$WORK/visits" &
clients=$!
class_began=$(date +%s.%N)
sleep 3
mapfile -t old < <(containers simulation)
begin=$(now)
docker service scale --detach fleet_simulation=6 >/dev/null
within 60 run_containers 6 simulation
started=$(now)
within 8 are 6 up
told 'from docker service scale 2 -> 6 until all six run' "$((started - begin)) ms"
told 'from then until the session server offers all six' "$(($(now) - started)) ms"
wait "$clients"
# shellcheck disable=SC2046 # Each is a word.
used=$(docker inspect $(containers simulation) | python3 tests/deploy/first_use.py "$WORK/visits" "$class_began" "${old[@]}") || fail "$used"
told 'from the start of each new server to its first client (5 s asked)' "$used"

# Four servers fewer while simulations run: each simulation runs to its end.
full_class 20
begin=$(now)
docker service scale --detach fleet_simulation=2 >/dev/null
within 20 are 2 up
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
full_class 20
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

# A killed server comes back; its client is notified and needs one click.
visit "$VIEWER" --kill fleet_simulation &
visitor=$!
within 60 has_said kill
whole() { are_healthy 2 simulation && are 2 up && are 0 down; }
until [[ $(now) -gt $(($(said kill) + 500)) ]]; do sleep 0.1; done
within 30 whole
told 'from docker kill of a simulation server until two are offered' "$(($(now) - $(said kill))) ms"
wait "$visitor"
told 'from docker kill until the page of its client tells it' "$(($(said told) - $(said kill))) ms"
told 'from docker kill until the scene moves again, after a click' "$(($(said again) - $(said kill))) ms"
(($(said told) - $(said kill) < 10000)) || fail 'its client was told too late'

full_class 10
available() { [[ $(get /request) == 1 ]]; }
longest=0
for session in $(containers session); do
    docker kill "$session" >/dev/null
    begin=$(now)
    within 5 available
    took=$(($(now) - begin))
    ((took <= longest)) || longest=$took
    within 30 are_healthy 2 session
done
wait "$clients"
told 'from docker kill of a session server until the door answers' "$longest ms at most"
told 'clients while both session servers are killed in turn, to the end' '10 of 10'

# After an edit only the changed service is deployed again.
before=$(containers simulation door)
sed -i 's/"title": "Carousel"/"title": "Merry-go-round"/' "$WORK/swarm/session.json"
deploy "$WORK/swarm/deploy" fleet
edited() { [[ $(get /viewer) == *Merry-go-round* && $(containers session | wc -l) == 2 ]]; }
within 60 edited
[[ $(containers simulation door) == "$before" ]] || fail 'servers whose configuration is the same were replaced'
told 'an edited configuration, deployed again' 'is used'

# The door forwards only to the fleet.
inside=$(servers up | cut -d ' ' -f 1)
session=$(docker inspect --format '{{(index .NetworkSettings.Networks "fleet_fleet").IPAddress}}' "$(containers session | head -n 1)")
[[ $(get "/${inside/://}/load") =~ ^[0-9.]+$ ]] || fail 'the door does not lead to a simulation server'
for path in /127.0.0.1/2000/load /10.99.0.1/2000/load /localhost/2000/load /simulation/2000/load /172.18.0.1/2000/load \
    "/$session/1999/status" "/${inside%:*}/22/" "/${inside%:*}/2021/" "/${inside%:*}/2000/drain" "/%0a${inside%:*}/2000/load"; do
    code=$(get "$path" --output /dev/null 2>/dev/null | grep --only-matching '404 Not Found' | head -n 1 || true)
    [[ $code == '404 Not Found' ]] || fail "the door leads to $path"
done
told 'paths to elsewhere that the door refuses' '10 of 10'

# Another fleet: with https, an image by another name, and simulation servers only on nodes with GPUs.
docker stack rm fleet >/dev/null
gone() { [[ -z $(docker ps --quiet) && -z $(docker network ls --quiet --filter name=fleet_fleet) ]]; }
within 60 gone
mkdir "$WORK/tls" "$WORK/x11"
openssl req -x509 -newkey rsa:2048 -nodes -days 1 -subj /CN=localhost -addext subjectAltName=DNS:localhost \
    -keyout "$WORK/tls/tls.key" -out "$WORK/tls/tls.crt" 2>/dev/null
mkdir -p "$WORK/tls/.well-known/acme-challenge"
echo answer >"$WORK/tls/.well-known/acme-challenge/question"
chown -R 101 "$WORK/tls"
# The simulation servers use the demo's configuration here too.
cp "$WORK/swarm/simulation.json" "$WORK/swarm/simulation-gpu.json"
docker tag webots-fleet/session-server:0.1.0 lab/session-server:1
export DOOR_PORT=80 FLEET_DOOR=wss://localhost SESSION=lab/session-server:1 SIMULATION=webots-fleet/simulation-demo:0.1.0 DOOR_TLS=$WORK/tls X11=$WORK/x11
deploy docker stack deploy --compose-file "$WORK/swarm/stack.yml" --compose-file "$WORK/swarm/https.yml" \
    --compose-file "$WORK/swarm/gpu.yml" fleet
pending() { docker service ps --no-trunc --format '{{.Error}}' fleet_simulation | grep 'scheduling constraints not satisfied'; }
within 30 pending
run_containers 0 simulation || fail 'a simulation server runs on a node without a GPU'
docker node update --label-add webots-fleet.gpu=true "$(docker node ls --quiet)" >/dev/null
visit https://localhost/viewer
told 'a scene in Chromium by https, on a node with the label of a GPU' moves
[[ $(in_machine curl --silent --output /dev/null --write-out '%{redirect_url}' http://localhost/viewer) == https://localhost/viewer ]] ||
    fail 'http does not lead to https'
[[ $(in_machine curl --silent http://localhost/.well-known/acme-challenge/question) == answer ]] ||
    fail 'a certificate could not be renewed: the question of its authority is not answered'
docker stack rm fleet >/dev/null
echo passed
