# run install dist arm64 test-arm64 viewer check test test-fast package verified · test-tools test-rerun test-lerobot judge-hiroz judge-franka vendor-sim deny advisories mutants ·
# bench bench-quick bench-page bench-share screenshots jitter soak lies lies-wire pauses curves fuzz

PYTHON ?= python3
# Most tests wait rather than compute. More at a time than this and whole runs no longer keep their time.
export NEXTEST_TEST_THREADS ?= $(shell echo $$((2 * $$(nproc))))
# Cargo features beside the default ones: `make test FEATURES=share`.
export FEATURES ?=
WITH := $(if $(FEATURES),--features $(FEATURES))
READERS := tests/readers
SYSTEM_TOOLS := cyclictest linux.uml insmod ip tc cansend chromium debootstrap
SYSTEM_PACKAGES := rt-tests user-mode-linux kmod iproute2 can-utils chromium debootstrap

TARGET := $(or $(CARGO_TARGET_DIR),target)
# Where the stripped program, its debug file and the packages go.
SHIPPED := $(TARGET)/shipped
# For all users where root installs, else for this user.
PREFIX ?= $(if $(filter 0,$(shell id -u)),/usr/local,$(HOME)/.local)
# What `make dist` makes packages for.
MACHINES ?= x86_64 aarch64
# No paths of the computer that built it.
SHORT_PATHS := --remap-path-prefix=$(or $(CARGO_HOME),$(HOME)/.cargo)/registry/src/=
# Without objcopy the linker drops the debug information.
STRIP := $(if $(shell command -v objcopy),,CARGO_PROFILE_DIST_STRIP=symbols)

# What the page of the live view is built from; nothing where it is not in this tree.
PAGE := viewer/dist/index.html
PAGE_SOURCES := $(wildcard viewer/*.json viewer/*.mjs) $(shell find viewer/src -type f 2>/dev/null)
NODE := $(if $(wildcard viewer/package.json),$(shell command -v npm))

.PHONY: run demo install dist arm64 test-arm64 shipped viewer viewer-if-possible check lint scripts spelling licences test test-fast package verified test-tools test-rerun test-lerobot judge-hiroz judge-franka vendor-sim deny advisories mutants bench bench-quick bench-page bench-share screenshots jitter soak lies lies-wire pauses curves fuzz

# Builds the program to try it, not optimized, and starts a shipped blueprint; its arms are simulated. Ends with Ctrl-C.
run: WHAT = run coordinator-yourarm
demo: WHAT = demo
run demo: viewer-if-possible
	@[ -e $(TARGET)/quick/dimos ] || echo "building dimos: 3 to 5 minutes the first time" >&2
	@trap : INT; cargo run --profile quick --locked -- $(WHAT) || [ $$? -eq 130 ]

# Installs program, man pages, completions and blueprints below PREFIX; below /usr/local also the systemd unit.
install: shipped
	packaging/install.sh $(SHIPPED)/dimos $(PREFIX) $(DESTDIR)
	@case ":$$PATH:" in *:$(PREFIX)/bin:*) ;; *) echo "note: $(PREFIX)/bin is not in PATH" ;; esac

# Makes a tarball, a Debian package and a Python wheel for each machine, in target/shipped, with SHA256SUMS. They want
# glibc 2.31. It fetches a cross linker from PyPI and, without rustup's targets, a compiler from Debian
# (packaging/build.sh): 300 MB, once, into target/cross.
dist: viewer
	@[ -e $(PAGE) ] || { echo "error: packages have the page of the live view" >&2; \
	echo "hint: install Node 18 or newer with npm" >&2; exit 1; }
	packaging/dist.sh $(SHIPPED) $(MACHINES)

# The program for aarch64, and an emulator that runs it here, for tests. The profile `quick` compiles sooner and runs
# slower; ARM64_PROFILE=dist takes that of `make dist`, which is compiled once for both.
ARM64_PROFILE ?= quick
arm64:
	packaging/emulated.sh $(ARM64_PROFILE)

# The other processor computes the same bits. Not part of `make test`: it compiles everything once more.
test-arm64: arm64
	cargo test --locked $(WITH) --test process other_machine -- --nocapture

# The optimized program without debug information, and its debug file.
shipped: viewer
	@echo "building dimos as it is shipped: several minutes" >&2
	$(STRIP) RUSTFLAGS="$(SHORT_PATHS)" cargo build --profile dist --locked --features share --bin dimos
	packaging/strip.sh $(TARGET)/dist/dimos $(SHIPPED)

# The page of the live view, which the next build embeds. Without Node that build embeds a page that says so.
viewer: $(if $(NODE),$(PAGE))
	@[ -e $(PAGE) ] || echo "note: no page of the live view: install Node with npm and build again, or a package (README.md), which has it" >&2

# For those who only try: without a network it does without.
viewer-if-possible:
	@npm_config_fetch_retries=0 $(MAKE) --no-print-directory viewer || echo "note: the page of the live view is not built; all else works" >&2

$(PAGE): viewer/node_modules/.package-lock.json $(PAGE_SOURCES)
	cd viewer && npm run --silent build
	@touch $@

viewer/node_modules/.package-lock.json: viewer/package.json viewer/package-lock.json
	cd viewer && npm ci --no-audit --no-fund
	@touch $@

check: lint scripts spelling licences

lint:
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --locked $(WITH) -- -D warnings
	cargo clippy --no-default-features --locked -- -D warnings

# Format, lints and types of Python (pyproject.toml) and of the page (viewer/biome.jsonc, viewer/tsconfig.json). The
# client and the shim are for Python 3.9; tests need what test-tools installs.
scripts:
	@if [ -x .venv/bin/ruff ] && [ -x .venv/bin/mypy ]; then PATH="$$PWD/.venv/bin:$$PATH"; set -ex; \
	ruff format --check; ruff check; mypy --strict assets/python; \
	mypy --python-version 3.11 tests/python tests/readers tests/suite.py; \
	else echo "note: Python is not checked; make test-tools installs ruff and mypy"; fi
	@if [ -x viewer/node_modules/.bin/biome ]; then cd viewer && npm run --silent check; \
	else echo "note: the page's TypeScript is not checked; make test-tools installs biome"; fi

spelling:
	@if [ -x .venv/bin/codespell ]; then .venv/bin/codespell; \
	else echo "note: spelling is not checked; make test-tools installs codespell"; fi

licences:
	@if cargo deny --version >/dev/null 2>&1; then $(MAKE) --no-print-directory deny; \
	else echo "note: licences and sources of crates are not checked; cargo install --locked cargo-deny"; fi

# Licences, sources and duplicates of all crates (deny.toml).
deny:
	cargo deny --all-features check bans licenses sources

# Dependencies against a copy of RustSec's database: make advisories DB=../advisory-db. Not part of CI: new ones appear
# without a change here.
advisories:
	@[ -e "$(DB)" ] || { echo "error: no advisory database: DB=$(DB)" >&2; \
	echo "hint: git clone https://github.com/RustSec/advisory-db, then make advisories DB=advisory-db" >&2; exit 1; }
	@cargo audit --version >/dev/null 2>&1 || { echo "error: no cargo-audit" >&2; \
	echo "hint: cargo install --locked cargo-audit" >&2; exit 1; }
	cargo audit --no-fetch --stale --db $(DB)

# Installs nothing: tests whose tools are missing are skipped.
test: viewer-if-possible
	@[ -e .venv/readers-installed ] || echo "note: some tests will be skipped; make test-tools installs what they need"
	cargo test --workspace --locked $(WITH) --doc
	@if ! cargo nextest --version >/dev/null 2>&1; then cargo test --workspace --locked $(WITH) --lib --bins --tests --examples; \
	elif command -v $(PYTHON) >/dev/null; then $(PYTHON) tests/suite.py; \
	else cargo nextest run --workspace --locked $(WITH); \
	fi

# The crates that others may use, and those that they use, as a registry takes them: each is built from its package.
package:
	cargo package --locked $(addprefix -p dimos-,core rt yaml kernels robot planner hardware)

# The logic, in a minute: no run of the program, no vendor's tool.
test-fast:
	@if cargo nextest --version >/dev/null 2>&1; \
	then cargo nextest run --workspace --locked --profile fast --lib --test logic; \
	else cargo test --workspace --locked --lib; \
	fi

# Writes docs/verified.md from the reports in docs/reports.
verified:
	DIMOS_REGENERATE=1 cargo test --locked --test logic verified::the_page

# What tests compare with and run in: other people's readers of logs; as root, also cyclictest, a browser, and a guest
# kernel that has CAN, with the tools for its interfaces, and a root with only Debian's base.
test-tools: .venv/readers-installed $(READERS)/node_modules/.package-lock.json viewer/node_modules/.package-lock.json .venv/bin/promtool
	@if [ "$$(id -u)" = 0 ]; then missing=; for tool in $(SYSTEM_TOOLS); do command -v $$tool >/dev/null || missing=yes; done; \
	[ -z "$$missing" ] || { apt-get update -q && apt-get install -qy --no-install-recommends $(SYSTEM_PACKAGES); }; \
	packaging/base.sh >/dev/null; fi

.venv/readers-installed: $(READERS)/requirements.txt $(READERS)/requirements-no-deps.txt
	$(PYTHON) -m venv .venv
	.venv/bin/pip install -q -r $<
	.venv/bin/pip install -q --no-deps -r $(READERS)/requirements-no-deps.txt
	touch $@

# From Debian's package, which is not installed: it would start a server.
.venv/bin/promtool: .venv/readers-installed
	@cd .venv && if apt-get download -q prometheus && dpkg -x prometheus_*.deb prometheus; \
	then mv prometheus/usr/bin/promtool bin/; else echo "note: promtool is not installed: apt-get update" >&2; fi; \
	rm -rf prometheus prometheus_*.deb

$(READERS)/node_modules/.package-lock.json: $(READERS)/package-lock.json
	cd $(READERS) && npm ci --no-audit --no-fund
	touch $@

# rerun is large (0.8 GB installed), so it is not part of test-tools.
test-rerun: .venv/readers-installed
	.venv/bin/pip install -q rerun-sdk==0.41.0
	.venv/bin/rerun analytics disable
	DIMOS_RERUN=1 cargo test --locked --test process readers::rerun

# An action client of ROS 2 in Rust, which compiles zenoh once more.
judge-hiroz: .venv/readers-installed
	cargo build --manifest-path tests/hiroz/Cargo.toml --target-dir $(TARGET)/hiroz
	DIMOS_HIROZ=$(abspath $(TARGET))/hiroz/debug/judge-hiroz cargo test --locked --features share --test process hiroz

# 50 motions at half and at full speed, judged by franka-sim: five minutes.
judge-franka: .venv/readers-installed
	DIMOS_FRANKA_SIM=50 cargo test --locked --test peers franka_sim -- --nocapture

# The first day at a simulator that others wrote, and its report: ARM=ur, xarm (containers of the vendors) or franka.
# docs/first-day.md says what of it has been run.
vendor-sim:
	cargo build --locked --bin dimos
	DIMOS=$(abspath $(TARGET))/debug/dimos tests/vendor_sim.sh

# LeRobot with all that it asks for is large (torch), so it has a venv of its own.
test-lerobot:
	[ -e .venv-lerobot/bin/python ] || $(PYTHON) -m venv .venv-lerobot
	.venv-lerobot/bin/pip install -q lerobot==0.4.4
	DIMOS_LEROBOT=1 cargo test --locked --test process log_verbs::lerobot

# Changes the code of the control path a little, hundreds of times, and runs the fast tests on each change: what no test
# notices is listed, without those in tests/mutants-equivalent.txt. Hours; `make mutants MUTANTS="--file crates/control/src/limit.rs"`
# is one file. Wants cargo-mutants and cargo-nextest.
mutants:
	cargo mutants $(MUTANTS) || [ $$? -eq 2 ] || [ $$? -eq 3 ]
	@sed '/^#/d; /^$$/d; s/  #.*//' tests/mutants-equivalent.txt >mutants.out/equivalent.txt
	@if sed 's/:[0-9]*:[0-9]*: /: /' mutants.out/missed.txt | grep -vxF -f mutants.out/equivalent.txt; \
	then echo "error: no test notices these changes" >&2; exit 1; fi

# Compute time of a tick, cost per arm, memory, start-up, processor time; the way to the wire and back; what talking to a
# run costs; how fast logs are written, read and verified. Writes what it measured into docs/figures.md.
bench:
	DIMOS_FIGURES=$(abspath docs/figures.md) cargo bench --locked --bench control --bench wire --bench rpc --bench recorder --bench verify

# Starts every benchmark in a form of a few seconds, without optimization: to see that each still runs. Fails where a part
# of one does not; its figures mean nothing.
bench-quick:
	cargo bench --locked $(WITH) --profile dev --bench control --bench jitter --bench planning --bench recorder --bench rpc --bench verify \
	--bench wire $(if $(findstring share,$(FEATURES)),--bench share) -- --quick

# How soon the page shows an arm in Chromium, its script time per frame with four arms, the processor time of its
# server, and the lateness of the tick with and without a page. ROUNDS=1: a quick one.
bench-page: viewer
	cargo build --release --locked --bin dimos
	DIMOS=$(abspath $(TARGET))/release/dimos node viewer/tests/bench.mjs

# The pictures of the arms' pages, in docs/images: shipped planners with their emulators, in Chromium.
screenshots: viewer
	cargo build --locked --bin dimos
	DIMOS=$(abspath $(TARGET))/debug/dimos node viewer/tests/pictures.mjs

# What a run on the network costs and how fast it is, over the loopback interface. PART=stops: one part of it.
bench-share:
	cargo bench --locked --features share --bench share -- $(PART)

# Lateness of the tick beside cyclictest.
jitter:
	cargo bench --locked --bench jitter

# Arms idle and moving beside eight busy processes for half an hour, with and without real-time permission, and runs that
# are stopped and continued 200 times: no arm may be held by that. A million targets that lead arms into contact: nothing
# may touch. Then an hour of the page of the live view, a day in virtual time, and an hour of a run that is visited every
# second: nothing may grow. Five hours on a machine without other work.
soak: viewer-if-possible
	DIMOS_SOAK=1800 cargo test --release --locked --test realtime stalls_soak -- --nocapture --test-threads 1
	DIMOS_SOAK=120 DIMOS_SOAK_ALL=1 cargo test --release --locked --test realtime stalls_soak -- --nocapture --test-threads 1
	DIMOS_STALLS=200 cargo test --release --locked --test realtime stalls:: -- --skip wire_stalls --nocapture --test-threads 1
	DIMOS_WIRE=full cargo test --release --locked --test realtime wire_stalls -- --nocapture --test-threads 1
	DIMOS_REPEATS=20 cargo test --release --locked --test realtime faults:: -- --nocapture --test-threads 1
	DIMOS_JOBS=1000 cargo test --locked --test process jobs::picks -- --nocapture
	DIMOS_BRAKING=1000 cargo test --locked --test logic braking
	DIMOS_GUARD_TARGETS=1000000 cargo test --release --locked --test logic guard::adversarial -- --nocapture
	DIMOS_PAGE_SOAK=60 cargo test --locked --test peers several_arms -- --nocapture
	DIMOS_DAY=24 cargo test --release --locked --test logic day:: -- --nocapture
	DIMOS_SOAK_HOUR=3600 cargo test --release --locked --test process soak:: -- --nocapture

# A million lying arms and a million honest ones in virtual time, in half an hour: rows, kinds of lies, broken rules.
lies:
	DIMOS_LIES=1000000 cargo test --release --locked --test logic lies::as_many -- --nocapture

# Emulated arms that lie on the wire of every protocol: 1,000 trials each, the arms side by side, in 90 minutes.
lies-wire:
	DIMOS_WIRE_LIES=1000 cargo test --locked --test realtime lies_on_the_wire -- --nocapture

# Pauses and lost messages at full speed: in virtual time every row, rate and length, at 200 moments each; on the wire
# of every protocol 25 of each, beside pylibfranka, in half an hour.
pauses:
	DIMOS_PAUSES=200 cargo test --release --locked --test logic pauses:: -- --nocapture
	DIMOS_WIRE_PAUSES=25 cargo test --locked --test realtime pauses_on_the_wire -- --nocapture

# Coverage-guided fuzzing of all that is read, and of what a run is asked: each target for a minute (SECONDS_EACH=600: longer;
# TARGETS="urdf mesh": only these). Wants g++. BUG=1, 2 or 3 plants a bug in each target, and fails where it is not found.
fuzz:
	fuzz/run.sh

# Lines, arcs and recorded paths of six arms, 54 of each, beside the shortest durations that CasADi finds: 15 minutes.
curves: .venv/readers-installed
	DIMOS_CURVES=9 cargo test --locked --test logic curves:: -- --nocapture
