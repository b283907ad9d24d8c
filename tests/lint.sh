#!/usr/bin/env bash
# Checks the JavaScript of the pages (types, lints, format, and its tests without a browser), the workflows of the hosted
# CI, and all Python (lints, format), in seconds: tests/lint.sh
# With --fix it first formats the files, and mends what can be mended without a decision.
set -eu
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
readonly JS=tests/assets TOOLS=tests/assets/node_modules
mapfile -t python < <(git ls-files '*.py'; git grep -lE '^#!.*python')

tests/install.sh node=nodejs npm=npm git=git python3=python3 python3-venv=python3-venv
# npm's own copy of the lock file lacks what other systems need, so it can't be compared.
if ! cmp -s "$JS/package-lock.json" "$TOOLS/installed.json"; then
    npm ci --prefix "$JS"
    cp "$JS/package-lock.json" "$TOOLS/installed.json"
fi
biome() {
    # It takes its settings from the folder that it runs in.
    (cd "$JS" && node_modules/.bin/biome check "$@" . ../../templates/assets)
}
ruff() {
    "$(dirname "$(tests/python.sh)")/ruff" "$@" "${python[@]}"
}

if [[ ${1-} == --fix ]]; then
    biome --write
    ruff check --config tests/ruff.toml --fix --quiet
    ruff format --config tests/ruff.toml
fi
biome --error-on-warnings
"$TOOLS/.bin/tsc" --project "$JS"
node --test --test-reporter=dot "$JS"/*.test.js
ruff check --config tests/ruff.toml
ruff format --config tests/ruff.toml --check
