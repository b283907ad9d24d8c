#!/usr/bin/env bash
# Starts and stops the servers of a configuration NAME: config/simulation/NAME.json and config/session/NAME.json.
#
# It needs Linux, bash, coreutils, util-linux (flock, setsid), git, and cargo where the programs are to be built.
# A server that runs has log/NAME.KIND.pid (its process) and log/NAME.KIND.out (what it prints).
# FLEET_BIN, an absolute path, names a folder with programs to use in place of building them.
set -u

readonly USAGE='usage: ./server.sh start|stop|restart|status [NAME]

  start    builds the programs if needed, starts the servers of NAME and waits until they answer
  stop     ends the servers of NAME; without NAME, all that run
  restart  stops and starts the servers of NAME; without NAME, all that run
  status   tells what runs, and where: exit code 0 if it does, 3 if not

NAME stands for config/simulation/NAME.json and config/session/NAME.json; without it, start takes local.'
# In the order in which they start; they stop in the opposite order.
readonly KINDS=(simulation session)
# How long a server may take to answer after its start, and what it starts to vanish after its end, in seconds.
readonly ANSWER=30 VANISH=15
# How long a server may take to end beyond its own limit, timing.stop, in seconds.
readonly GRACE=6

say() { printf '%s\n' "$*"; }

fail() { # CODE MESSAGE
    printf 'error: %s\n' "$2" >&2
    exit "$1"
}

config_of() { printf 'config/%s/%s.json' "$1" "$2"; }
pid_file_of() { printf 'log/%s.%s.pid' "$2" "$1"; }
output_of() { printf 'log/%s.%s.out' "$2" "$1"; }

# The kinds of servers that NAME configures.
kinds_of() { # NAME
    local kind
    for kind in "${KINDS[@]}"; do
        [[ ! -f $(config_of "$kind" "$1") ]] || say "$kind"
    done
}

# All names that are configured.
names() {
    local file
    for file in config/simulation/*.json config/session/*.json; do
        [[ ! -f $file ]] || basename "$file" .json
    done | sort -u
}

# Whether a process is there; one that has ended and was not waited for does not count.
alive() { # PID
    local stat
    { read -r stat <"/proc/$1/stat"; } 2>/dev/null && [[ ${stat##*) } != [ZX]* ]]
}

# The process of a server that runs. A process id in a file says little: it may be another's by now.
pid_of() { # KIND NAME
    local pid arguments
    { read -r pid <"$(pid_file_of "$1" "$2")"; } 2>/dev/null || return 1
    [[ $pid =~ ^[0-9]+$ ]] || return 1
    { mapfile -d '' -t arguments <"/proc/$pid/cmdline"; } 2>/dev/null || return 1
    [[ ${arguments[0]-} == */"$1-server" && ${arguments[1]-} == "$(config_of "$1" "$2")" ]] || return 1
    [[ /proc/$pid/cwd -ef . ]] || return 1
    say "$pid"
}

# The names that were started and not stopped.
started_names() {
    local file name
    for file in log/*.pid; do
        name=${file#log/} name=${name%.pid}
        [[ ! -f $file ]] || say "${name%.*}"
    done | sort -u
}

# The names of which a server runs.
running_names() {
    local name kind
    for name in $(started_names); do
        for kind in "${KINDS[@]}"; do
            if pid_of "$kind" "$name" >/dev/null; then say "$name"; fi
        done
    done | sort -u
}

# Reads what a server's configuration amounts to into `effective`, and where it is reached into HOST, PORT (from this
# machine), HTTP and WS (from outside).
declare -A effective
read_configuration() { # KIND NAME
    local text line secure='' separator=:
    text=$("$BIN/$1-server" --check "$(config_of "$1" "$2")" 2>"$REMARKS") || {
        cat "$REMARKS" >&2
        return 2
    }
    effective=()
    while IFS= read -r line; do
        [[ $line =~ ^\ +\"([A-Za-z]+)\":\ \"?([^\",]*)\"?,?$ ]] && effective[${BASH_REMATCH[1]}]=${BASH_REMATCH[2]}
    done <<<"$text"
    [[ ${effective[ssl]} == false ]] || secure=s
    [[ ${effective[portRewrite]} == false ]] || separator=/
    PORT=${effective[port]}
    HTTP="http$secure://${effective[server]}$separator$PORT"
    WS="ws$secure://${effective[server]}$separator$PORT"
    HOST=${effective[bind]}
    HOST=${HOST#[} HOST=${HOST%]}
    case $HOST in
        0.0.0.0) HOST=127.0.0.1 ;;
        ::) HOST=::1 ;;
    esac
}

# Passes on what the last check warns of. The demo simulator needs no display.
warn() {
    local line
    while IFS= read -r line; do
        [[ $line == 'warning: '* ]] || continue
        [[ $line == 'warning: display: '* && ${effective[webots]-} == */demo-simulator ]] || printf '%s\n' "$line" >&2
    done <"$REMARKS"
}

# Whether something listens on HOST and PORT.
listens() { (exec 3<>"/dev/tcp/$HOST/$PORT") 2>/dev/null; }

# Whether the server on HOST and PORT answers requests.
answers() {
    (
        exec 3<>"/dev/tcp/$HOST/$PORT" || exit
        printf 'GET /health HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n' >&3
        read -r -t 3 line <&3 && [[ $line == 'HTTP/1.1 200 '* ]]
    ) 2>/dev/null
}

# Waits until processes are gone.
wait_until_gone() { # SECONDS PID...
    local ticks=$((10 * $1)) pid
    shift
    for pid in "$@"; do
        while alive "$pid"; do
            ((ticks-- > 0)) || return 1
            sleep 0.1
        done
    done
}

# Fails unless NAME is one that is configured.
check_name() { # NAME
    [[ $1 =~ ^[A-Za-z0-9][A-Za-z0-9._-]*$ ]] && [[ -n $(kinds_of "$1") ]] && return
    local known
    known=$(names)
    fail 2 "there is no configuration $1: neither $(config_of simulation "$1") nor $(config_of session "$1"). There is: ${known//$'\n'/, }"
}

build() {
    [[ -z ${FLEET_BIN-} ]] || return 0
    command -v cargo >/dev/null || PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
    if command -v cargo >/dev/null; then
        cargo build --release --locked --bins --target-dir target && return
        command -v cc >/dev/null || fail 1 'a C compiler is missing (on Debian and Ubuntu: apt-get install gcc libc6-dev)'
        fail 1 'the programs could not be built'
    fi
    [[ -x $BIN/simulation-server && -x $BIN/session-server ]] ||
        fail 1 'cargo is needed to build the programs; https://rustup.rs tells how to install it'
}

# Makes a project that lies in config/NAME a git repository, cache/NAME.git, as a forge would have it.
publish() { # NAME
    [[ -d config/$1 ]] || return 0
    command -v git >/dev/null || fail 1 'git is needed (on Debian and Ubuntu: apt-get install git)'
    (
        # Nothing of the user's own settings counts here.
        export GIT_CONFIG_NOSYSTEM=1 GIT_CONFIG_GLOBAL=/dev/null
        export GIT_DIR="$PWD/cache/$1.git" GIT_WORK_TREE="$PWD/config/$1" GIT_INDEX_FILE="$PWD/cache/$1.git/index"
        export GIT_AUTHOR_NAME='Webots fleet' GIT_AUTHOR_EMAIL=fleet@localhost
        export GIT_COMMITTER_NAME='Webots fleet' GIT_COMMITTER_EMAIL=fleet@localhost
        set -e
        mkdir -p cache
        env -u GIT_WORK_TREE git init --quiet --bare "$GIT_DIR"
        git symbolic-ref HEAD refs/heads/main
        git add --all --force .
        tree=$(git write-tree)
        old=$(git rev-parse --quiet --verify 'main^{tree}' || true)
        if [[ $tree != "$old" ]]; then
            commit=$(git commit-tree "$tree" -m "The project in config/$1")
            git update-ref refs/heads/main "$commit"
        fi
    )
}

# Everything that can be found wrong before something is started or stopped.
prepare() { # NAME
    local kind
    check_name "$1"
    build
    for kind in $(kinds_of "$1"); do
        read_configuration "$kind" "$1" || exit
        warn
        ((PORT > 0)) || fail 2 "$(config_of "$kind" "$1"): port: a server that is started here needs a port of its own, not 0"
    done
}

# One at a time: the lock ends with this process, and is kept from those that it starts.
lock() {
    exec 9<server.sh
    flock --nonblock 9 && return
    say 'waiting for another ./server.sh that is at work'
    flock --timeout 120 9 || fail 1 'another ./server.sh is still at work'
}

start() { # NAME
    local kind pid started=()
    for kind in $(kinds_of "$1"); do
        if pid=$(pid_of "$kind" "$1"); then
            fail 1 "the $kind server of $1 already runs (process $pid); './server.sh restart $1' starts it anew"
        fi
    done
    for kind in $(kinds_of "$1"); do
        read_configuration "$kind" "$1" 2>/dev/null || exit
        listens && fail 1 "port $PORT, which $(config_of "$kind" "$1") names, is taken$(who_runs)"
    done
    mkdir -p log
    publish "$1" || fail 1 "no git repository could be made of config/$1"
    for kind in $(kinds_of "$1"); do
        started=("$kind" "${started[@]}")
        if ! launch "$kind" "$1"; then
            undo "$1" "${started[@]}"
            exit 1
        fi
    done
    for kind in $(kinds_of "$1"); do tell "$kind" "$1"; done
}

# Ends what a start that failed had started.
undo() { # NAME KIND...
    local name=$1 kind
    shift
    for kind in "$@"; do stop_one "$kind" "$name" >/dev/null; done
}

# Adds to a message which servers of this project run.
who_runs() {
    local names
    names=$(running_names)
    [[ -z $names ]] || printf '; of this project, this runs already: %s' "${names//$'\n'/, }"
}

launch() { # KIND NAME
    local output pid ticks=$((10 * ANSWER))
    output=$(output_of "$1" "$2")
    read_configuration "$1" "$2" 2>/dev/null || return
    (
        # The demo simulator is to be reached from where its server is.
        [[ ! ${effective[bind]} =~ ^[0-9.]+$ ]] || export DEMO_SIMULATOR_BIND="${DEMO_SIMULATOR_BIND-${effective[bind]}}"
        exec setsid "$BIN/$1-server" "$(config_of "$1" "$2")" </dev/null >"$output" 2>&1 9<&-
    ) &
    pid=$!
    say "$pid" >"$(pid_file_of "$1" "$2")"
    while alive "$pid" && ((ticks-- > 0)); do
        if answers && alive "$pid"; then return 0; fi
        sleep 0.1
    done
    if alive "$pid"; then
        say "error: the $1 server of $2 does not answer on port $PORT. It printed ($output):" >&2
    else
        say "error: the $1 server of $2 has ended at once. It printed ($output):" >&2
    fi
    tail -n 10 "$output" >&2
    return 1
}

stop_one() { # KIND NAME
    local pid children limit
    if ! pid=$(pid_of "$1" "$2"); then
        rm -f "$(pid_file_of "$1" "$2")"
        return 1
    fi
    limit=10
    read_configuration "$1" "$2" 2>/dev/null && limit=$((${effective[stop]%.*} + 1))
    # Each simulation is below a child of its server that ends after it.
    read -r -d '' -a children < <(cat "/proc/$pid/task"/*/children 2>/dev/null)
    kill -TERM "$pid"
    if wait_until_gone $((limit + GRACE)) "$pid"; then
        say "stopped the $1 server of $2 (process $pid)"
    else
        kill -KILL "$pid"
        wait_until_gone 5 "$pid"
        say "killed the $1 server of $2 (process $pid): it had not ended within $((limit + GRACE)) seconds"
    fi
    wait_until_gone "$VANISH" "${children[@]}" ||
        say "warning: of the $1 server of $2 there are still processes: ${children[*]}" >&2
    rm -f "$(pid_file_of "$1" "$2")"
}

stop() { # NAME
    local index stopped=false
    for ((index = ${#KINDS[@]} - 1; index >= 0; index--)); do
        stop_one "${KINDS[index]}" "$1" && stopped=true
    done
    $stopped || say "nothing of $1 runs"
}

# Where a server is reached.
tell() { # KIND NAME
    local path=/session
    [[ $1 == session ]] || path=/client
    read_configuration "$1" "$2" 2>/dev/null
    printf '%-18s %s/monitor   %s%s\n' "$1 server" "$HTTP" "$WS" "$path"
}

status() { # NAME
    local kind pid all=true
    for kind in $(kinds_of "$1"); do
        if ! pid=$(pid_of "$kind" "$1"); then
            say "$1: the $kind server does not run"
            all=false
        elif ! read_configuration "$kind" "$1" 2>/dev/null; then
            say "$1: the $kind server runs (process $pid), but its configuration can't be read any more"
        elif answers; then
            say "$1: the $kind server runs (process $pid): $HTTP/monitor"
        else
            say "$1: the $kind server runs (process $pid), but does not answer on port $PORT"
        fi
    done
    $all
}

# Does something with each of these names, whatever comes of the others.
for_each() { # ACTION NAME...
    local action=$1 name code=0
    shift
    for name in "$@"; do ("$action" "$name") || code=$?; done
    return "$code"
}

main() {
    (($# == 1 || $# == 2)) || fail 2 "$USAGE"
    cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")" || exit 1
    local names
    if (($# == 2)); then
        names=("$2")
    elif [[ $1 == stop ]]; then
        mapfile -t names < <(started_names)
    else
        mapfile -t names < <(running_names)
    fi
    BIN=${FLEET_BIN:-$PWD/target/release}
    REMARKS=$(mktemp) || exit 1
    trap 'rm -f "$REMARKS"' EXIT
    case $1 in
        start)
            names=("${2-local}")
            prepare "${names[0]}"
            lock
            start "${names[0]}"
            ;;
        restart)
            ((${#names[@]} > 0)) || names=(local)
            for_each prepare "${names[@]}" || exit
            lock
            for_each stop "${names[@]}"
            for_each start "${names[@]}"
            ;;
        stop)
            (($# == 1)) || check_name "$2"
            lock
            ((${#names[@]} > 0)) || say 'nothing runs'
            for_each stop "${names[@]}"
            ;;
        status)
            (($# == 1)) || check_name "$2"
            ((${#names[@]} > 0)) || { say 'nothing runs'; exit 3; }
            for_each status "${names[@]}" || exit 3
            ;;
        -h | --help | help) say "$USAGE" ;;
        *) fail 2 "$USAGE" ;;
    esac
}

main "$@"
