# Makes clean Debian systems with mmdebstrap. To be sourced.
# shellcheck shell=bash

# FLEET_MIRROR, or else the first mirror in this machine's apt sources; empty if there is none.
debian_mirror() {
    local mirror=${FLEET_MIRROR-}
    [[ -n $mirror ]] || mirror=$(sed -nE 's/^URIs: *([^ ]+).*/\1/p; s/^deb (\[[^]]*\] )?([^ ]+).*/\2/p' \
        /etc/apt/sources.list /etc/apt/sources.list.d/*.{sources,list} 2>/dev/null || true)
    printf '%s\n' "${mirror%%$'\n'*}"
}

# Makes a system with these packages, as a folder or an archive (NAME.tar).
make_debian() { # DISTRIBUTION PACKAGES TARGET OPTION FOR mmdebstrap...
    local mirror components=main
    mirror=$(debian_mirror)
    [[ $mirror != *ubuntu* ]] || components=main,universe
    mmdebstrap --variant=minbase --components="$components" --dpkgopt=force-unsafe-io --include="$2" "${@:4}" "$1" "$3" "$mirror"
}
