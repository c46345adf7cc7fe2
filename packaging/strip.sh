#!/bin/sh
# Takes the debug information out of a program, into a file beside it that debuggers find by its name.
#
#   packaging/strip.sh PROGRAM FOLDER      writes FOLDER/dimos and FOLDER/dimos-VERSION-MACHINE.debug
#
# Without objcopy (Debian: binutils) the program is copied as it is.
set -eu
[ $# -eq 2 ] || { sed -n '2,6s/^# \{0,1\}//p' "$0" >&2; exit 2; }
version=$(sed -n 's/^version = "\(.*\)"/\1/p' "$(dirname "$0")/../Cargo.toml" | head -n 1)
debug=dimos-$version-$(uname -m).debug
mkdir -p "$2"
install -m 755 "$1" "$2/dimos"
cd "$2"
if command -v objcopy >/dev/null; then
    objcopy --only-keep-debug dimos "$debug"
    chmod 644 "$debug"
    objcopy --strip-all --remove-section=.gnu_debuglink --add-gnu-debuglink="$debug" dimos
fi
