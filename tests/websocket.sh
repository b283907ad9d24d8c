#!/usr/bin/env bash
# A WebSocket client that needs nothing but bash and coreutils: tests/websocket.sh ws://HOST:PORT/PATH [MESSAGE]
#
# Sends MESSAGE, then each line of its input, and prints each text that it receives. It ends when the server closes; at the
# end of its input it keeps receiving (Ctrl-C ends it). For tries by hand: no TLS, short messages only.
set -u
LC_ALL=C

if ! [[ ${1-} =~ ^ws://([^:/]+):([0-9]+)(/.*)?$ ]] || (($# > 2)); then
    echo 'usage: tests/websocket.sh ws://HOST:PORT/PATH [MESSAGE]' >&2
    exit 2
fi
host=${BASH_REMATCH[1]} port=${BASH_REMATCH[2]} path=${BASH_REMATCH[3]:-/}

# Sends a frame, masked with zeros: clients must mask, and zeros change nothing.
send() { # OPCODE HEX
    local length=$((${#2} / 2)) header escaped='' byte
    if ((length < 126)); then
        printf -v header '%02x%02x' $((128 + $1)) $((128 + length))
    else
        printf -v header '%02xfe%04x' $((128 + $1)) "$length"
    fi
    for byte in $(fold -w 2 <<<"${header}00000000$2"); do escaped+=\\x$byte; done
    printf '%b' "$escaped" >&3
}

hex() { od -An -v -tx1 | tr -d ' \n'; }

# Reads this many bytes; fails if fewer are left.
take() { # COUNT
    local bytes
    bytes=$(head -c "$1" <&3 | hex)
    ((${#bytes} == 2 * $1)) && printf '%s' "$bytes"
}

listen() {
    local head length
    while head=$(take 2); do
        length=$((16#${head:2} & 127))
        case $length in
            126) length=$((16#$(take 2))) || return ;;
            127) length=$((16#$(take 8))) || return ;;
        esac
        case $((16#${head:0:2} & 15)) in
            1 | 0) head -c "$length" <&3 && echo ;;
            8) return ;;
            9) send 10 "$(take "$length")" ;;
            *) take "$length" >/dev/null ;;
        esac
    done
}

exec 3<>"/dev/tcp/$host/$port" || exit 1
printf 'GET %s HTTP/1.1\r\nHost: %s:%s\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n' "$path" "$host" "$port" >&3
printf 'Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n' >&3
IFS= read -r answer <&3
while IFS= read -r line <&3 && [[ $line != $'\r' ]]; do :; done
if [[ $answer != 'HTTP/1.1 101 '* ]]; then
    printf '%s\n' "${answer%$'\r'}" >&2
    exit 1
fi

(($# < 2)) || send 1 "$(printf '%s' "$2" | hex)"
exec 4<&0
while IFS= read -r line; do send 1 "$(printf '%s' "$line" | hex)"; done <&4 &
trap 'kill $! 2>/dev/null' EXIT
listen
