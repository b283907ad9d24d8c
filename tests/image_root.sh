#!/usr/bin/env bash
# Makes an archive of a Debian with the system packages of the images: Xvfb, xauth, Python and make for Webots' image, those that the Dockerfiles of
# deploy/docker install, and nginx. It is made once and kept.
# image_root.sh ARCHIVE
# It has this machine's distribution, so that programs built here run in it. Ends with 77 if it can't be made.
set -Eeuo pipefail
archive=$1
cd "$(dirname "$(readlink -f "$0")")/.."
# shellcheck source=tests/debian.sh
. tests/debian.sh
# shellcheck disable=SC1091
distribution=$(. /etc/os-release && echo "${VERSION_CODENAME-}")
readonly packages=xvfb,xauth,python3,make,ca-certificates,curl,git,tini,nginx-light
readonly made="$distribution $packages"

mkdir -p "$(dirname "$archive")"
exec {lock}>"$archive.lock"
flock "$lock"
[[ ! -s $archive || $(<"$archive.complete") != "$made" ]] || exit 0
command -v mmdebstrap >/dev/null && [[ -n $(debian_mirror) ]] || exit 77
echo "makes the Debian of the images, once: $distribution"
rm -f "$archive.complete"
# The images need no manuals and no OpenGL, whose compiler is half of the size.
left_out=()
for folder in share/doc share/man share/locale 'lib/*/dri' 'lib/*/libLLVM'; do left_out+=("--dpkgopt=path-exclude=/usr/$folder*"); done
make_debian "$distribution" "$packages" "$archive" --skip=output/dev "${left_out[@]}" >"$archive.log" 2>&1 || {
    tail -n 5 "$archive.log" >&2
    exit 1
}
echo "$made" >"$archive.complete"
