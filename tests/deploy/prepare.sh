#!/usr/bin/env bash
# Makes what the scripts beside this one share and what needs no programs under test, so that they need not wait for it.
# shellcheck source=tests/deploy/machine.sh
. "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/machine.sh"

prepare_root
