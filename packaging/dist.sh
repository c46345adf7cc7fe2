#!/bin/sh
# Makes all that is shipped of this version: for each machine a tarball, a Debian package, a Python wheel and a file
# with debug information; and their SHA-256 sums.
#
#   packaging/dist.sh FOLDER [MACHINE…]        MACHINE: x86_64, aarch64; default: both
#
# packaging/build.sh says what this needs and fetches.
set -eu
[ $# -ge 1 ] || { sed -n '2,7s/^# \{0,1\}//p' "$0" >&2; exit 2; }
mkdir -p "$1"
out=$(realpath "$1")
shift
[ $# -gt 0 ] || set -- x86_64 aarch64
cd "$(dirname "$0")/.."
target=$(realpath "${CARGO_TARGET_DIR:-target}")
built() { echo "$target/$1-unknown-linux-gnu/dist/dimos"; }

for machine; do
    echo "building dimos for $machine as it is shipped: several minutes" >&2
    packaging/build.sh "$machine" dist
done
# Man pages and completions are written by a program that runs here.
here=$(uname -m)
[ -x "$(built "$here")" ] || packaging/build.sh "$here" dist
DIMOS_HERE=$(built "$here") PYTHON=$target/cross/python/bin/python
PATH=$target/cross/bin:$PATH
export DIMOS_HERE PYTHON PATH
for machine; do
    packaging/strip.sh "$(built "$machine")" "$out/$machine" "$machine"
    packaging/package.sh "$out/$machine/dimos" "$out" "$machine"
done
cd "$out"
version=$(./"$here"/dimos --version 2>/dev/null || "$DIMOS_HERE" --version)
version=$(echo "$version" | sed 's/^dimos \([^ ]*\).*/\1/')
sha256sum dimos[-_]*"$version"[-_]*.* >SHA256SUMS
