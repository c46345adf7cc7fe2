#!/usr/bin/env bash
# Runs targets under libFuzzer, each for a while, beginning with their seeds and what is kept in fuzz/corpus.
#   SECONDS_EACH=60 TARGETS="urdf mesh" BUG=1 fuzz/run.sh
# What it finds is in target/fuzz/found/TARGET: put it into fuzz/corpus/TARGET, where `make test` replays it, and mend it.
set -euo pipefail
cd "$(dirname "$0")/.."
each=${SECONDS_EACH:-60} bug=${BUG:-0}
host=$(rustc -vV | sed -n 's/^host: //p')
out=$PWD/target/fuzz

# The compiler's own instrumentation, which the stable toolchain has: build scripts and macros go without.
flags="-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 -Cllvm-args=-sanitizer-coverage-inline-8bit-counters"
flags+=" -Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares -Cdebug-assertions"
flags+=" -Coverflow-checks -Ccodegen-units=16"
env -u RUSTC_WORKSPACE_WRAPPER RUSTFLAGS="$flags" cargo build --quiet --locked --profile fuzz -p dimos-fuzz --features engine \
	--target "$host" --target-dir "$out"
program=$out/$host/fuzz/fuzz
export XDG_CACHE_HOME=$out/cache XDG_RUNTIME_DIR=$out/run
mkdir -p -m 700 "$XDG_CACHE_HOME" "$XDG_RUNTIME_DIR" "$out/found"

failed=0
for name in ${TARGETS:-$("$program" --list 2>/dev/null)}; do
	work=$(mktemp -d -p "$out")
	mkdir -p "$out/found/$name" "$out/corpus/$name"
	DIMOS_FUZZ=$name "$program" --prepare "$work" 2>/dev/null
	before=$(date +%s)
	# Planted bugs are found from the seeds alone.
	new=$out/corpus/$name words=()
	[[ $bug = 0 ]] || new=$work/new
	mkdir -p "$new"
	[[ ! -s $work/words ]] || words=(-dict="$work/words")
	status=0
	DIMOS_FUZZ=$name DIMOS_FUZZ_BUG=$bug "$program" -max_total_time="$each" -timeout=20 -rss_limit_mb=2048 -max_len=4096 \
		-use_value_profile=1 "${words[@]}" -artifact_prefix="$out/found/$name/" -print_final_stats=1 \
		"$new" "$work/corpus" >"$work/log" 2>&1 || status=$?
	took=$(($(date +%s) - before))
	runs=$(sed -n 's/^stat::number_of_executed_units: *//p' "$work/log")
	cover=$(grep -o 'cov: [0-9]*' "$work/log" | tail -1 || true)
	if [[ $bug != 0 ]]; then
		if grep -q "planted bug $bug" "$work/log"; then
			echo "$name: bug $bug found after $took s"
		else
			echo "$name: bug $bug is not found within $took s, $cover" && failed=1
		fi
	elif [[ $status = 0 ]]; then
		echo "$name: $runs inputs in $took s, $cover"
	else
		echo "$name: something is wrong after $took s: $out/found/$name"
		grep -m1 -A3 -E "panicked at|ERROR: libFuzzer" "$work/log" || true
		failed=1
	fi
	rm -rf "$work"
done
exit $failed
