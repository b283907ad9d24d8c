#!/usr/bin/env bash
# Installs commands that are missing, through apt: tests/install.sh COMMAND=PACKAGE[,PACKAGE...]...
# Prints what it installs, or the command to run if it can't.
set -eu

missing=() packages=()
for pair in "$@"; do
    command=${pair%%=*}
    case $command in
        # python3 may lack venv, which is a separate package on Debian.
        python3-venv) python3 -c 'import ensurepip, venv' 2>/dev/null && continue ;;
        *) command -v "$command" >/dev/null && continue ;;
    esac
    missing+=("$command")
    IFS=, read -r -a more <<<"${pair#*=}"
    packages+=("${more[@]}")
done
((${#missing[@]} > 0)) || exit 0

echo "missing: ${missing[*]}"
root=()
if ((EUID != 0)); then
    root=(sudo)
    [[ -t 0 ]] || root+=(--non-interactive)
fi
if ! command -v apt-get >/dev/null || ! "${root[@]}" true; then
    echo "error: they can't be installed from here. On Debian and Ubuntu: apt-get install ${packages[*]}" >&2
    exit 1
fi
echo "installing: ${packages[*]}"
"${root[@]}" apt-get update --quiet --quiet
"${root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install --yes --quiet --quiet --no-install-recommends "${packages[@]}"
