#!/bin/sh
# Builds the program for computers with glibc 2.31 or newer (Debian 11, Ubuntu 20.04, Raspberry Pi OS 11), with all arms
# and the network: target/MACHINE-unknown-linux-gnu/PROFILE/dimos.
#
#   packaging/build.sh MACHINE PROFILE [FEATURES]      MACHINE: x86_64 or aarch64; FEATURES: default share, the network
#
# Needs cargo, a C compiler, and Python with venv. Fetches once, into target/cross:
#
#   from PyPI     cargo-zigbuild and ziglang (a linker and a C compiler that know every glibc), wheel: 100 MB
#   from Debian   rustc-web and its standard libraries for both machines: 125 MB. Not if rustc has both, as after
#                 rustup target add aarch64-unknown-linux-gnu x86_64-unknown-linux-gnu
set -eu
[ $# -ge 2 ] || { sed -n '2,12s/^# \{0,1\}//p' "$0" >&2; exit 2; }
machine=$1 profile=$2 features=${3-share}
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-target}
mkdir -p "$target/cross"
cross=$(realpath "$target/cross")

if [ ! -e "$cross/python/installed" ]; then
    echo "fetching from PyPI, into $cross/python: cargo-zigbuild, ziglang, wheel" >&2
    "${PYTHON:-python3}" -m venv "$cross/python"
    "$cross/python/bin/pip" install -q --disable-pip-version-check cargo-zigbuild==0.24.1 ziglang==0.17.1 wheel
    touch "$cross/python/installed"
fi

# One compiler for both machines: what it computes in advance is then the same.
has() { [ -n "$(ls "$(rustc --print target-libdir --target "$1-unknown-linux-gnu")" 2>/dev/null)" ]; }
rustc=$cross/debian/rustc
if [ ! -x "$rustc" ] && ! { has x86_64 && has aarch64; }; then
    # Its file names have the versions.
    debian() { packaging/debian.sh "$cross/debian" "$@"; }
    depends() {
        APT_CONFIG="$cross/debian/.apt/conf" apt-cache --no-all-versions show "$1" | sed -n "s/^Depends:.*\($2[0-9.]*\).*/\1/p"
    }
    debian rustc-web libstd-rust-web-dev:amd64 libstd-rust-web-dev:arm64
    std=$(depends libstd-rust-web-dev libstd-rust-web-)
    debian "$std" "$(depends "$std" libllvm)"
    printf '#!/bin/sh\nLD_LIBRARY_PATH=${0%%/*}/usr/lib/%s-linux-gnu exec "${0%%/*}/usr/bin/rustc" "$@"\n' \
        "$(uname -m)" >"$rustc"
    chmod 755 "$rustc"
fi
[ ! -x "$rustc" ] || export RUSTC="$rustc"
# Clippy belongs to another compiler.
unset RUSTC_WORKSPACE_WRAPPER RUSTC_WRAPPER
# No paths of the computer that built it.
export RUSTFLAGS="--remap-path-prefix=${CARGO_HOME:-$HOME/.cargo}/registry/src/="
PATH="$cross/python/bin:$PATH" exec cargo zigbuild --profile "$profile" --locked --features "$features" --bin dimos \
    --target "$machine-unknown-linux-gnu.2.31"
