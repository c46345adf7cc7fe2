#!/bin/sh
# Tries packages where nothing else is: in roots with only a Debian base, without network. Times the Debian package
# until a simulated arm has moved, and the wheel until a motion is planned; removes both and lists what is left.
#
#   packaging/try.sh FOLDER [SUITE]     FOLDER: of `make dist`; SUITE: of Debian, default that of this computer
#
# As root, with debootstrap (packaging/base.sh).
set -eu
[ $# -ge 1 ] || { sed -n '2,7s/^# \{0,1\}//p' "$0" >&2; exit 2; }
packages=$(realpath "$1")
# Mounts, processes and network are those of this script: no other run is seen, and nothing stays.
if [ -z "${TRY_BASE:-}" ]; then
    TRY_BASE=$("$(dirname "$0")/base.sh" ${2:+"$2"})
    export TRY_BASE
    exec unshare --mount --pid --net --fork "$0" "$packages"
fi
base=$TRY_BASE
work=$(mktemp -d)
trap 'umount -R "$work"/*/proc "$work"/*/dev 2>/dev/null; rm -rf --one-file-system "$work"' EXIT
ip link set lo up 2>/dev/null || echo "note: no ip: the run has no loopback interface" >&2

# root NAME BASE: a fresh root with a user.
root() {
    cp -a "$2" "$work/$1"
    mount -t proc proc "$work/$1/proc"
    mount --rbind --make-rslave /dev "$work/$1/dev"
    chroot "$work/$1" useradd --create-home tester
}
# as NAME COMMAND: as that user, with nothing in the environment.
as() { chroot --userspec=tester:tester "$work/$1" env -i HOME=/home/tester PATH=/usr/bin:/bin sh -euc "cd; $2"; }
list() { (cd "$work/$1" && find . -xdev \( -path ./proc -o -path ./dev -o -path ./tmp -o -path ./home \) -prune -o -print | sort); }
now() { date +%s%N; }
took() { printf '%s: %d.%d s\n' "$2" "$((($(now) - $1) / 1000000000))" "$((($(now) - $1) / 100000000 % 10))"; }
only() { find "$packages" -maxdepth 1 -name "$1"; }
machine=$(uname -m)

root deb "$base"
cp "$(only "dimos_*_$(dpkg --print-architecture).deb")" "$work/deb/tmp/dimos.deb"
list deb >"$work/before"
began=$(now)
chroot "$work/deb" apt-get install -qq --no-install-recommends /tmp/dimos.deb >/dev/null 2>&1
took "$began" "Debian package, installed"
as deb 'dimos run -d coordinator-yourarm >/dev/null
        dimos move arm 0.3 -0.2 0.5 0 0.4 0 >/dev/null'
took "$began" "Debian package, from nothing to the end of the first motion"
as deb 'dimos down >/dev/null; dimos log verify --last >/dev/null; dimos doctor | grep -q "systemctl --user start"'
chroot "$work/deb" apt-get purge -qq --yes dimos >/dev/null 2>&1
list deb >"$work/after"
# apt's and dpkg's own records of what they did.
left=$(comm -13 "$work/before" "$work/after" | grep -v -e '^./var/log/' -e '^./var/cache/' -e '^./var/lib/dpkg/' -e '^./var/lib/apt/' -e '^./etc/.*-$' || true)

root wheel "$base-python"
wheel=$(only "dimos_arm-*_$machine.whl")
cp "$wheel" "$work/wheel/tmp/"
as wheel 'python3 -m venv --without-pip venv; venv/bin/python3 -m ensurepip --default-pip >/dev/null 2>&1; find venv ! -type d | sort >before'
began=$(now)
as wheel "venv/bin/pip install --quiet --no-index /tmp/$(basename "$wheel")"
as wheel 'venv/bin/dimos run -d yourarm-planner >/dev/null
          venv/bin/dimos plan arm 0.3 -0.2 0.5 0 0.4 0 >/dev/null'
took "$began" "wheel, from nothing to a plan"
as wheel 'venv/bin/python -c "from dimos_client import Client; print(Client.connect().plan(\"arm\", named=\"home\").duration > 0)" | grep -q True
          venv/bin/dimos down >/dev/null; venv/bin/pip uninstall --quiet --yes dimos-arm; find venv ! -type d | sort >after'
left="$left$(as wheel 'comm -13 before after' | grep -v __pycache__ || true)"
if [ -n "$left" ]; then
    printf 'error: removed packages leave:\n%s\n' "$left" >&2
    exit 1
fi
echo "removed: nothing is left but logs"
