#!/usr/bin/env bash
# Starts and stops the servers of a configuration NAME: simulation/NAME and session/NAME.
#
# It needs Linux, bash, coreutils, util-linux (flock, setsid), git, and cargo if it builds the programs.
# A server KIND/NAME reads config/KIND/NAME.json, keeps log/KIND/NAME.pid locked while it runs, and prints to
# log/KIND/NAME.out.
# FLEET_BIN is the absolute path of a folder with programs to use instead of building them. A release has them in bin.
set -u

readonly USAGE='usage: ./server.sh start|stop|restart|status [NAME]

  start    builds the programs if needed, starts the servers of NAME that do not run and waits until they answer
  stop     ends the servers of NAME; without NAME, all that run
  restart  starts the servers of NAME anew; without NAME, all that run. No simulation ends: the simulation server before
           serves its simulations until their clients leave. A changed port, bind or cacheDir needs stop and start
  status   tells what runs, and where: exit code 0 if it does, 3 if not

NAME stands for config/simulation/NAME.json and config/session/NAME.json; without it, start takes local.'

fail() { # CODE MESSAGE
    printf 'error: %s\n' "$2" >&2
    exit "$1"
}

# The servers of NAME, in the order in which they start.
servers() { # NAME
    [[ ! -f config/simulation/$1.json ]] || echo "simulation/$1"
    [[ ! -f config/session/$1.json ]] || echo "session/$1"
}

# The process id of a server, if it runs.
pid_of() { # SERVER
    [[ -f log/$1.pid ]] && ! flock --nonblock "log/$1.pid" true && cat "log/$1.pid"
}

# The names that have a running server.
running() {
    local file
    for file in log/*/*.pid; do
        [[ ! -f $file ]] || flock --nonblock "$file" true || basename "$file" .pid
    done | sort --unique
}

check() { # NAME
    [[ $1 =~ ^[A-Za-z0-9][A-Za-z0-9._-]*$ && -n $(servers "$1") ]] && return
    fail 2 "there is neither config/simulation/$1.json nor config/session/$1.json. NAME can be:
$(basename --multiple --suffix=.json config/s*/*.json | sort --unique)"
}

# A value of a server's effective configuration.
setting() { # SERVER KEY
    "$BIN/${1%/*}-server" --check "config/$1.json" 2>/dev/null | sed -n "s/^ *\"$2\": \"\{0,1\}\([^\",]*\).*/\1/p"
}

# Whether a program is newer than its sources; cargo takes longer to find out.
is_current() { # PROGRAM
    [[ -x $BIN/$1 && -e $BIN/.$1.began ]] &&
        [[ -z $(find src templates config/simulation/docker Cargo.toml Cargo.lock rust-toolchain.toml -newer "$BIN/.$1.began" -print -quit) ]]
}

# Builds the programs that NAME needs.
build() { # NAME
    local server program programs=() options=() current=true missing=false
    for server in $(servers "$1"); do programs+=("${server%/*}-server"); done
    ! grep --quiet --no-messages demo-simulator "config/simulation/$1.json" || programs+=(demo-simulator)
    for program in "${programs[@]}"; do
        options+=(--bin "$program")
        is_current "$program" || current=false
        [[ -x $BIN/$program ]] || missing=true
    done
    ! $current || return 0
    ! $missing || echo 'builds the programs first, which takes about three minutes on two cores'
    mkdir -p "$BIN" || fail 1 "the programs can't be built in $BIN"
    touch "$BIN/.began"
    PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin cargo build --release --locked "${options[@]}" --target-dir target ||
        fail 1 'building the programs needs cargo (https://rustup.rs) and a C compiler'
    for program in "${programs[@]}"; do touch --reference="$BIN/.began" "$BIN/.$program.began"; done
}

# Builds the programs and checks the configurations before anything is started or stopped.
prepare() { # NAME
    local server remarks
    [[ -n ${FLEET_BIN-} ]] || build "$1"
    for server in $(servers "$1"); do
        remarks=$("$BIN/${server%/*}-server" --check "config/$server.json" 2>&1 >/dev/null) || fail 2 "${remarks#error: }"
        # The demo simulator needs no display, and listens on the loopback only.
        [[ $(setting "$server" webots) != */demo-simulator ]] || remarks=$(grep -vE '^warning: (display|streams): ' <<<"$remarks")
        grep '^warning: ' <<<"$remarks" >&2 || true
        # The isolation of worlds depends on the packages of the machine.
        grep -E '^(isolation|network): ' <<<"$remarks" || true
    done
}

# Publishes a project in config/NAME as a git repository, cache/NAME.git, as a Git host does.
publish() ( # NAME
    [[ -d config/$1 ]] || exit 0
    # Ignores the user's git settings.
    export GIT_CONFIG_NOSYSTEM=1 GIT_CONFIG_GLOBAL=/dev/null
    git init --quiet --bare "cache/$1.git" || exit
    export GIT_DIR=$PWD/cache/$1.git GIT_WORK_TREE=$PWD/config/$1
    git symbolic-ref HEAD refs/heads/main && git add --all --force || exit
    git diff --cached --quiet HEAD 2>/dev/null ||
        git -c user.name='Webots fleet' -c user.email=fleet@localhost commit --quiet --message="The project in config/$1"
)

# Starts a server and waits until it prints its URLs.
launch() { # SERVER
    local kind=${1%/*} deadline=$((SECONDS + 30)) bind
    mkdir -p "log/$kind"
    # The demo simulator listens on the same address as its server.
    bind=$(setting "$1" bind)
    : >"log/$1.out"
    DEMO_SIMULATOR_BIND=${DEMO_SIMULATOR_BIND-$bind} setsid "$BIN/$kind-server" --pid-file "log/$1.pid" \
        "config/$1.json" </dev/null >"log/$1.out" 2>&1 9<&- &
    until grep --max-count=1 "^$kind server " "log/$1.out"; do
        if ! kill -0 $! 2>/dev/null || ((SECONDS > deadline)); then
            echo "error: the $kind server of ${1#*/} has not started. It printed (log/$1.out):" >&2
            tail --lines=10 "log/$1.out" >&2
            return 1
        fi
        sleep 0.1
    done
}

start() { # NAME
    local server pid others missing=() started=()
    for server in $(servers "$1"); do
        if pid=$(pid_of "$server"); then
            others+="the ${server%/*} server of $1 already runs (process $pid)"$'\n'
        else
            missing+=("$server")
        fi
    done
    if ((${#missing[@]} == 0)); then
        [[ $action != restart ]] || return 0
        fail 1 "${others%$'\n'}; './server.sh restart $1' starts it anew"
    fi
    [[ $action == restart ]] || printf %s "${others-}"
    publish "$1" || fail 1 "no git repository could be made of config/$1"
    for server in "${missing[@]}"; do
        started=("$server" "${started[@]}")
        launch "$server" && continue
        stop "$1" "${started[@]}" >/dev/null
        others=$(running)
        [[ -z $others ]] || echo "Of this project, this runs already: ${others//$'\n'/, }" >&2
        exit 1
    done
}

stop() { # NAME [SERVER...]; without SERVER, all of NAME
    local server pid limit outcome nothing=true
    (($# > 1)) || set -- "$1" "session/$1" "simulation/$1"
    for server in "${@:2}"; do
        if pid=$(pid_of "$server"); then
            limit=$(setting "$server" stop) outcome=stopped nothing=false
            kill -TERM "$pid"
            # A server ends at the latest shortly after timing.stop.
            if ! flock --timeout $((${limit%.*} + 10)) "log/$server.pid" true; then
                kill -KILL "$pid"
                flock --timeout 10 "log/$server.pid" true
                outcome=killed
            fi
            echo "$outcome the ${server%/*} server of $1 (process $pid)"
        fi
        rm -f "log/$server.pid"
    done
    ! $nothing || echo "nothing of $1 runs"
}

# Has a running simulation server hand over to a new process, and stops the session server.
renew() { # NAME
    local said
    if pid_of "simulation/$1" >/dev/null; then
        said=$("$BIN/simulation-server" upgrade "config/simulation/$1.json") || return
        echo "the simulation server of $1 runs anew: $said"
    fi
    ! pid_of "session/$1" >/dev/null || stop "$1" "session/$1"
}

status() { # NAME
    local server pid code=0
    for server in $(servers "$1"); do
        if pid=$(pid_of "$server"); then
            echo "$1: the ${server%/*} server runs (process $pid)"
            grep --max-count=1 "^${server%/*} server " "log/$server.out"
        else
            echo "$1: the ${server%/*} server does not run"
            code=3
        fi
    done
    return "$code"
}

# Runs ACTION for each name, even if it fails for others.
for_each() { # ACTION
    local name code=0
    for name in "${names[@]}"; do ("$1" "$name") || code=$?; done
    return "$code"
}

if (($# < 1 || $# > 2)) || [[ $1 != @(start|stop|restart|status) ]]; then
    fail 2 "$USAGE"
fi
readonly action=$1
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")" || exit 1
[[ ! -x bin/session-server ]] || FLEET_BIN=${FLEET_BIN:-$PWD/bin}
readonly BIN=${FLEET_BIN:-$PWD/target/release}
if (($# == 2)); then
    check "$2"
    names=("$2")
else
    mapfile -t names < <(if [[ $1 == start ]]; then echo local; else running; fi)
fi
((${#names[@]} > 0)) || { echo 'nothing runs'; [[ $1 != status ]] || exit 3; exit; }
[[ $1 != *start ]] || for_each prepare || exit
# One server.sh at a time. The lock ends with this process; the servers do not inherit it.
exec 9<server.sh
flock --nonblock 9 || echo 'waiting for another ./server.sh that is at work'
flock --timeout 120 9 || fail 1 'another ./server.sh is still at work'
[[ $action != restart ]] || for_each renew || exit
for_each "${action#re}"
