#!/bin/sh
# Makes roots with only Debian's base, for packaging/try.sh: target/cross/base-SUITE, and one with Python.
#
#   packaging/base.sh [SUITE]       default: that of this computer
#
# As root, with debootstrap; fetches 100 MB from Debian, once. Prints the folder.
set -eu
cd "$(dirname "$0")/.."
suite=${1:-$(. /etc/os-release && echo "$VERSION_CODENAME")}
mkdir -p "${CARGO_TARGET_DIR:-target}/cross"
base=$(realpath "${CARGO_TARGET_DIR:-target}/cross")/base-$suite
if [ ! -e "$base/made" ]; then
    echo "fetching Debian's base, into $base" >&2
    rm -rf "$base" "$base-python"
    debootstrap --variant=minbase "$suite" "$base" >&2
    cp -a "$base" "$base-python"
    chroot "$base-python" apt-get install -qq --yes --no-install-recommends python3-venv >&2
    touch "$base/made"
fi
echo "$base"
