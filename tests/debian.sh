# What makes Debian roots by debootstrap. To be sourced.
# shellcheck shell=bash

# The first mirror that apt of this machine has, or FLEET_MIRROR; nothing if there is none.
debian_mirror() {
    local mirror=${FLEET_MIRROR-}
    [[ -n $mirror ]] || mirror=$(sed -nE 's/^URIs: *([^ ]+).*/\1/p; s/^deb (\[[^]]*\] )?([^ ]+).*/\2/p' \
        /etc/apt/sources.list /etc/apt/sources.list.d/*.{sources,list} 2>/dev/null || true)
    printf '%s\n' "${mirror%%$'\n'*}"
}

# The script of debootstrap for a distribution; a system that is newer than debootstrap is made as the others of its family.
debootstrap_script() { # DISTRIBUTION MIRROR
    local script=/usr/share/debootstrap/scripts/$1
    [[ -e $script || $2 != *ubuntu* ]] || script=/usr/share/debootstrap/scripts/gutsy
    printf '%s\n' "$script"
}
