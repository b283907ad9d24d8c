#!/usr/bin/env bash
# Makes the archive of a Debian with what images of Webots have of the system: Xvfb, xauth, Python, make. Once, it is kept.
# root.sh ARCHIVE
# It is of the distribution of this machine, whose programs run in it. Ends with 77 where it can't be made.
set -Eeuo pipefail
archive=$1
cd "$(dirname "$(readlink -f "$0")")/../.."
# shellcheck source=tests/debian.sh
. tests/debian.sh
# shellcheck disable=SC1091
distribution=$(. /etc/os-release && echo "${VERSION_CODENAME-}")
readonly packages=xvfb,xauth,python3,make
readonly made="$distribution $packages"

exec {lock}>"$archive.lock"
flock "$lock"
[[ ! -s $archive || $(<"$archive.complete") != "$made" ]] || exit 0
mirror=$(debian_mirror)
command -v debootstrap >/dev/null && [[ -n $mirror ]] || exit 77
echo "makes the Debian of the images, once: $distribution"
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
rm -f "$archive.complete"
debootstrap --variant=minbase --include="$packages" "$distribution" "$root" "$mirror" \
    "$(debootstrap_script "$distribution" "$mirror")" >"$archive.log" 2>&1 || {
    tail -n 5 "$archive.log" >&2
    exit 1
}
tar -C "$root" --exclude=./var/cache/apt --exclude=./var/lib/apt/lists --exclude=./usr/share/doc --exclude=./usr/share/man \
    --exclude=./usr/share/locale --exclude=./dev -cf "$archive.new" .
mv "$archive.new" "$archive"
echo "$made" >"$archive.complete"
