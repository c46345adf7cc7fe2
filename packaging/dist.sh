#!/bin/sh
# Makes what is shipped from a stripped program: a tarball and a Debian package.
#
#   packaging/dist.sh PROGRAM FOLDER
#
# COMPRESS=none does it in a second, for tests.
set -eu
[ $# -eq 2 ] || { sed -n '2,6s/^# \{0,1\}//p' "$0" >&2; exit 2; }
mkdir -p "$2"
program=$(realpath "$1") out=$(realpath "$2")
cd "$(dirname "$0")/.."
umask 022

version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
machine=$(uname -m)
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
mkdir "$work/control"
libc=$(objdump -T "$program" 2>/dev/null | sed -n 's/.*(GLIBC_\([0-9.]*\)).*/\1/p' | sort -Vu | tail -n 1)
size=$(du -sk "$work/deb" | cut -f 1)
sed -e "s/@VERSION@/$version/" -e "s/@ARCHITECTURE@/$architecture/" -e "s/@SIZE@/$size/" \
    -e "s/@LIBC@/${libc:-$(getconf GNU_LIBC_VERSION | cut -d ' ' -f 2)}/" packaging/deb/control >"$work/control/control"
install -m 755 packaging/deb/postinst "$work/control/postinst"
(cd "$work/deb" && find . -type f -printf '%P\n' | LC_ALL=C sort | xargs md5sum) >"$work/control/md5sums"
printf '2.0\n' >"$work/debian-binary"
pack "$work/control" | gzip -9n >"$work/control.tar.gz"
pack "$work/deb" | $small >"$work/data.tar$ending"
package=dimos_${version}_$architecture.deb
rm -f "$out/$package"
(cd "$work" && ar rcD "$out/$package" debian-binary control.tar.gz "data.tar$ending")

for made in "$program" "$out/$package" "$out/$name.tar$ending"; do
    printf '%8s KB  %s\n' "$(($(stat -c %s "$made") / 1000))" "$(basename "$made")"
done
