#!/bin/sh
# Counts the lines of code in `src` and in the tests, without comments and blank lines. The demo simulator and the
# rehearsal don't count for `src`; its unit tests (from `#[cfg(test)]` to the end of a file) count as tests.
#
# Usage: tests/count-lines.sh [FOLDER...]    only these folders of `src`, each with its own line
set -eu
cd "$(dirname "$0")/.."

# Counts the lines of code in standard input.
code() {
    grep -cvE '^[[:space:]]*(//.*)?$' || true
}

# Prints the sources below these folders: the lines before their unit tests (`code`), or from there on (`tests`).
part() {
    what=$1; shift
    find "$@" -name '*.rs' -not -path '*/demo_simulator/*' -not -path '*/rehearse/*' -exec awk -v what="$what" '
        FNR == 1 { inside = "code" }
        /^#\[cfg\(test\)\]$/ { inside = "tests" }
        inside == what' {} +
}

for folder in "$@"; do
    echo "$folder: $(part code "$folder" | code)"
done
if [ $# -eq 0 ]; then
    unit=$(part tests src | code)
    outside=$(find tests -name '*.rs' -exec cat {} + | code)
    echo "src: $(part code src | code)"
    echo "tests: $((unit + outside)), of which $unit are unit tests in src"
fi
