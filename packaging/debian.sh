#!/bin/sh
# Unpacks packages of Debian, of any of its architectures, below a folder: nothing is installed, no root is needed.
#
#   packaging/debian.sh FOLDER PACKAGE[:ARCHITECTURE]…
#
# apt-get takes them from where this computer's own packages come from, and checks their signatures. A package that is
# there already is not taken again.
set -eu
[ $# -ge 2 ] || { sed -n '2,7s/^# \{0,1\}//p' "$0" >&2; exit 2; }
command -v apt-get >/dev/null && command -v dpkg-deb >/dev/null || {
    echo "error: $0: apt-get and dpkg-deb are missing" >&2
    echo "hint: this needs Debian or Ubuntu; elsewhere: rustup target add aarch64-unknown-linux-gnu" >&2
    exit 1
}
mkdir -p "$1/.apt/state/lists/partial" "$1/.apt/cache/archives/partial"
root=$(realpath "$1")
shift
missing=
for package; do [ -e "$root/.apt/$package" ] || missing="$missing $package"; done
[ -n "$missing" ] || exit 0

# apt as on an empty computer that takes packages of both architectures.
cat >"$root/.apt/conf" <<END
Dir::State "$root/.apt/state";
Dir::State::status "/dev/null";
Dir::Cache "$root/.apt/cache";
Dir::Log "$root/.apt";
APT::Architectures { "$(dpkg --print-architecture)"; "amd64"; "arm64"; };
APT::Sandbox::User "";
END
export APT_CONFIG="$root/.apt/conf"
echo "fetching from Debian, into $root:$missing" >&2
fresh=$(find "$root/.apt/state/lists" -maxdepth 1 -type f -mmin -60 | head -n 1)
[ -n "$fresh" ] || apt-get -qq update
cd "$root/.apt/cache"
for package in $missing; do
    rm -f ./*.deb
    apt-get -qq download "$package"
    dpkg-deb -x ./*.deb "$root"
    rm -f ./*.deb
    touch "$root/.apt/$package"
done
