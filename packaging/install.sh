#!/bin/sh
# Puts a built program and all that belongs to it under a prefix: man pages, completions, systemd unit, blueprints,
# Python client, documents. Used by `make install`, the tarball and the Debian package.
#
#   packaging/install.sh PROGRAM PREFIX [DESTDIR]
#
# Files go to DESTDIR/PREFIX; what is written into them, such as the unit's path of the program, is below PREFIX. Where
# PROGRAM is for another machine, DIMOS_HERE is the same program for this one.
set -eu
[ $# -ge 2 ] || { sed -n '2,8s/^# \{0,1\}//p' "$0" >&2; exit 2; }
cd "$(dirname "$0")/.."
program=$1 prefix=${2%/} root=${3:-}$2
umask 022

file() { # MODE FILE… FOLDER
    mode=$1; shift
    for folder; do :; done
    mkdir -p "$folder"
    while [ $# -gt 1 ]; do install -m "$mode" "$1" "$folder/"; shift; done
}

file 755 "$program" "$root/bin"
dimos=${DIMOS_HERE:-$root/bin/dimos}

mkdir -p "$root/share/man/man1"
"$dimos" man --dir "$root/share/man/man1" 2>/dev/null
gzip -9nf "$root"/share/man/man1/dimos*.1

# Debian's zsh looks elsewhere than others.
zsh=${ZSH_COMPLETIONS:-share/zsh/site-functions}
mkdir -p "$root/share/bash-completion/completions" "$root/$zsh" "$root/share/fish/vendor_completions.d"
"$dimos" completions bash >"$root/share/bash-completion/completions/dimos"
"$dimos" completions zsh >"$root/$zsh/_dimos"
"$dimos" completions fish >"$root/share/fish/vendor_completions.d/dimos.fish"

file 644 blueprints/*.yaml "$root/share/dimos/blueprints"
file 644 assets/python/*.py assets/python/pyproject.toml "$root/share/dimos/python"
file 644 assets/python/dimos_client/*.py assets/python/dimos_client/py.typed "$root/share/dimos/python/dimos_client"
file 644 assets/blueprint.schema.json "$root/share/dimos"
file 644 README.md "$root/share/doc/dimos"
file 644 docs/*.md docs/foxglove-layout.json "$root/share/doc/dimos/docs"
file 644 docs/arms/*.md "$root/share/doc/dimos/docs/arms"
install -m 644 LICENSE "$root/share/doc/dimos/copyright"
# The licences of what is linked into the program ask for their texts beside it.
python3 packaging/notices.py | gzip -9n >"$root/share/doc/dimos/THIRD-PARTY-NOTICES.gz"
chmod 644 "$root/share/doc/dimos/THIRD-PARTY-NOTICES.gz"

# Units, users and devices are the system's: none for a user's own prefix.
case $prefix in
/usr | /usr/local)
    for scope in system user; do
        mkdir -p "$root/lib/systemd/$scope"
        sed "s|^ExecStart=[^ ]*|ExecStart=$prefix/bin/dimos|" "assets/system/dimos-$scope@.service" \
            >"$root/lib/systemd/$scope/dimos@.service"
    done
    file 644 assets/system/dimos-can@.service "$root/lib/systemd/system"
    file 644 assets/system/60-dimos.rules "$root/lib/udev/rules.d"
    file 644 assets/system/sysusers.conf "$root/lib/sysusers.d"
    mv "$root/lib/sysusers.d/sysusers.conf" "$root/lib/sysusers.d/dimos.conf"
    file 644 assets/system/limits.conf "$root/share/dimos"
    ;;
esac
