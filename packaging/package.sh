#!/bin/sh
# Makes what is shipped from a stripped program: a tarball, a Debian package and a Python wheel.
#
#   packaging/package.sh PROGRAM FOLDER [MACHINE]      MACHINE: x86_64 or aarch64; default: this one
#
# For another machine DIMOS_HERE is the same program for this one. PYTHON has the package `wheel`. COMPRESS=none does it
# in a second, for tests.
set -eu
[ $# -ge 2 ] || { sed -n '2,7s/^# \{0,1\}//p' "$0" >&2; exit 2; }
mkdir -p "$2"
program=$(realpath "$1") out=$(realpath "$2")
cd "$(dirname "$0")/.."
umask 022

version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
machine=${3:-$(uname -m)}
case $machine in
x86_64) architecture=amd64 ;;
aarch64) architecture=arm64 ;;
armv7l) architecture=armhf ;;
*) architecture=$machine ;;
esac
# The same commit gives the same packages.
date=@${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || date +%s)}
pack() { tar --sort=name --owner=0 --group=0 --numeric-owner --mtime="$date" --format=gnu -C "$1" -cf - .; }
case ${COMPRESS:-best} in
none) small=cat ending='' ;;
*) small='xz -9e' ending=.xz ;;
esac

# The oldest C library that it runs with: the newest of which it wants a symbol.
libc=$(readelf --wide --version-info "$program" | grep -o 'GLIBC_[0-9.]*' | sed 's/GLIBC_//' | sort -Vu | tail -n 1)

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# The tarball: unpack it anywhere and run bin/dimos, or copy it over /usr/local.
name=dimos-$version-$machine-linux
packaging/install.sh "$program" /usr/local "$work/tar"
mkdir "$work/tarball"
mv "$work/tar/usr/local" "$work/tarball/$name"
pack "$work/tarball" | $small >"$out/$name.tar$ending"

# The Debian package: an archive of three members.
ZSH_COMPLETIONS=share/zsh/vendor-completions packaging/install.sh "$program" /usr "$work/deb"
mkdir -p "$work/control" "$work/deb/etc/security/limits.d"
install -m 644 assets/system/limits.conf "$work/deb/etc/security/limits.d/90-dimos.conf"
echo /etc/security/limits.d/90-dimos.conf >"$work/control/conffiles"
size=$(du -sk "$work/deb" | cut -f 1)
sed -e "s/@VERSION@/$version/" -e "s/@ARCHITECTURE@/$architecture/" -e "s/@SIZE@/$size/" \
    -e "s/@LIBC@/$libc/" packaging/deb/control >"$work/control/control"
install -m 755 packaging/deb/postinst packaging/deb/postrm "$work/control/"
(cd "$work/deb" && find . -type f -printf '%P\n' | LC_ALL=C sort | xargs md5sum) >"$work/control/md5sums"
printf '2.0\n' >"$work/debian-binary"
pack "$work/control" | gzip -9n >"$work/control.tar.gz"
pack "$work/deb" | $small >"$work/data.tar$ending"
package=dimos_${version}_$architecture.deb
rm -f "$out/$package"
(cd "$work" && ar rcD "$out/$package" debian-binary control.tar.gz "data.tar$ending")

# The wheel: program, client, and the tree of the tarball as the environment's data.
wheel=$work/wheel/dimos_arm-$version
packaging/install.sh "$program" "$wheel/dimos_arm-$version.data/data"
(
    cd "$wheel/dimos_arm-$version.data"
    mv data/bin scripts
    mv data/share/dimos/python/dimos_client "$wheel/"
    rm -r data/share/dimos/python
)
info=$wheel/dimos_arm-$version.dist-info
mkdir -p "$info/licenses"
install -m 644 LICENSE "$info/licenses/LICENSE"
sed -e "s/@VERSION@/$version/" packaging/wheel/METADATA | cat - README.md >"$info/METADATA"
sed -e "s/@TAG@/py3-none-manylinux_$(echo "$libc" | tr . _)_$machine/" packaging/wheel/WHEEL >"$info/WHEEL"
SOURCE_DATE_EPOCH=${date#@} "${PYTHON:-python3}" -m wheel pack --dest-dir "$out" "$wheel" >/dev/null
wheel=$(find "$out" -name "dimos_arm-$version-*_$machine.whl")

for made in "$program" "$out/$package" "$out/$name.tar$ending" "$wheel"; do
    printf '%8s KB  %s\n' "$(($(stat -c %s "$made") / 1000))" "$(basename "$made")"
done
