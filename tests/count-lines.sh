#!/bin/sh
# Counts the lines of code in `src` and in the tests. Comments, blank lines, the demo simulator and the rehearsal don't
# count for `src`; its unit tests (from `#[cfg(test)]` to the end of a file) count as tests.
#
# Usage: tests/count-lines.sh [FOLDER...]    only these folders of `src`, each with its own line
set -eu
cd "$(dirname "$0")/.."

# Prints the lines of code that standard input has.
code() {
    grep -cvE '^[[:space:]]*(//.*)?$' || true
}

# Prints what the sources under the arguments have before (`code`) or from (`tests`) their unit tests on.
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
