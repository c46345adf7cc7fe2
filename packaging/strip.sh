#!/bin/sh
# Takes the debug information out of a program, into a file beside it that debuggers find by its name.
#
#   packaging/strip.sh PROGRAM FOLDER [MACHINE]   writes FOLDER/dimos and FOLDER/dimos-VERSION-MACHINE.debug
#
# With the objcopy of rustup's compiler, which knows every machine, or one for that machine (Debian: binutils,
# binutils-aarch64-linux-gnu). Without one the program is copied as it is.
set -eu
[ $# -ge 2 ] || { sed -n '2,7s/^# \{0,1\}//p' "$0" >&2; exit 2; }
version=$(sed -n 's/^version = "\(.*\)"/\1/p' "$(dirname "$0")/../Cargo.toml" | head -n 1)
machine=${3:-$(uname -m)}
objcopy=$(find "$(rustc --print sysroot)/lib/rustlib" -path '*/bin/rust-objcopy' 2>/dev/null | head -n 1)
[ -n "$objcopy" ] || objcopy=$machine-linux-gnu-objcopy
command -v "$objcopy" >/dev/null || [ "$machine" != "$(uname -m)" ] || objcopy=objcopy
debug=dimos-$version-$machine.debug
mkdir -p "$2"
install -m 755 "$1" "$2/dimos"
cd "$2"
if command -v "$objcopy" >/dev/null; then
    "$objcopy" --only-keep-debug dimos "$debug"
    chmod 644 "$debug"
    "$objcopy" --strip-all --remove-section=.gnu_debuglink --add-gnu-debuglink="$debug" dimos
else
    echo "note: $2/dimos keeps its debug information: no objcopy for $machine" >&2
fi
