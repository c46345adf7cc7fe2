#!/bin/sh
# Builds the program for aarch64, and what runs it on this computer: target/cross/dimos-aarch64, for tests.
#
#   packaging/emulated.sh PROFILE      dist: that of the packages; others without the network, in half the time
#
# packaging/build.sh says what this needs and fetches; and from Debian an emulator and a C library (65 MB).
set -eu
[ $# -eq 1 ] || { sed -n '2,7s/^# \{0,1\}//p' "$0" >&2; exit 2; }
cd "$(dirname "$0")/.."
features=
[ "$1" != dist ] || features=share
packaging/build.sh aarch64 "$1" "$features"
target=$(realpath "${CARGO_TARGET_DIR:-target}")
root=$target/cross/arm64
packaging/debian.sh "$root" "qemu-user-static:$(dpkg --print-architecture)" libc6:arm64 libgcc-s1:arm64
printf '#!/bin/sh\nexec %s -L %s %s "$@"\n' "$root/usr/bin/qemu-aarch64-static" "$root" \
    "$target/aarch64-unknown-linux-gnu/$1/dimos" >"$target/cross/dimos-aarch64"
chmod 755 "$target/cross/dimos-aarch64"
