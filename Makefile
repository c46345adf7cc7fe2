# run install check test test-fast · test-tools test-rerun · bench bench-quick jitter soak

PYTHON ?= python3
READERS := tests/readers
SYSTEM_TOOLS := cyclictest linux.uml insmod ip tc cansend
SYSTEM_PACKAGES := rt-tests user-mode-linux kmod iproute2 can-utils

.PHONY: run install check test test-fast test-tools test-rerun bench bench-quick jitter soak

# Builds the program and starts the shipped blueprint; its arm is simulated. Ends with Ctrl-C.
run:
	cargo run --release -- run coordinator-yourarm

# Installs `dimos` for this user.
install:
	cargo install --path . --locked

check:
	cargo fmt --check
	cargo clippy --all-targets --locked -- -D warnings
	cargo clippy --no-default-features --locked -- -D warnings

# Installs nothing: tests whose tools are missing are skipped.
test:
	@[ -e .venv/readers-installed ] || echo "note: some tests will be skipped; make test-tools installs what they need"
	cargo test --locked --doc
	@if cargo nextest --version >/dev/null 2>&1; \
	then cargo nextest run --locked; \
	else cargo test --locked --lib --bins --tests; \
	fi

# The logic, in a minute and a half: no run of the program, no vendor's tool.
test-fast:
	@if cargo nextest --version >/dev/null 2>&1; \
	then cargo nextest run --locked --profile fast --lib --test logic; \
	else cargo test --locked --lib; \
	fi

# What tests compare with and run in: other people's readers of logs; as root, also cyclictest, and a guest kernel that
# has CAN, with the tools for its interfaces.
test-tools: .venv/readers-installed $(READERS)/node_modules/.package-lock.json
	@if [ "$$(id -u)" = 0 ]; then missing=; for tool in $(SYSTEM_TOOLS); do command -v $$tool >/dev/null || missing=yes; done; \
	[ -z "$$missing" ] || { apt-get update -q && apt-get install -qy --no-install-recommends $(SYSTEM_PACKAGES); }; \
	fi

.venv/readers-installed: $(READERS)/requirements.txt
	$(PYTHON) -m venv .venv
	.venv/bin/pip install -q -r $<
	touch $@

$(READERS)/node_modules/.package-lock.json: $(READERS)/package-lock.json
	cd $(READERS) && npm ci --no-audit --no-fund
	touch $@

# rerun is large (0.8 GB installed), so it is not part of test-tools.
test-rerun: .venv/readers-installed
	.venv/bin/pip install -q rerun-sdk==0.41.0
	.venv/bin/rerun analytics disable
	DIMOS_RERUN=1 cargo test --locked --test process readers::rerun

# Compute time of a tick, cost per arm, memory, start-up, processor time; the way to the wire and back; what talking to a
# run costs; how fast logs
# are verified.
bench:
	cargo bench --locked --bench control --bench wire --bench rpc --bench verify

# Starts every benchmark in a form of a few seconds, without optimization: to see that each still runs. Fails where a part
# of one does not; its figures mean nothing.
bench-quick:
	cargo bench --locked --profile dev --bench control --bench jitter --bench planning --bench rpc --bench verify \
	--bench wire -- --quick

# Lateness of the tick beside cyclictest.
jitter:
	cargo bench --locked --bench jitter

# Arms idle and moving beside eight busy processes for half an hour, and runs that are stopped and continued 200 times: no
# arm may be held by that. An hour and a half.
soak:
	DIMOS_SOAK=1800 DIMOS_SOAK_BUSY=4 cargo test --locked --test realtime stalls_soak -- --nocapture --test-threads 2
	DIMOS_SOAK=120 DIMOS_SOAK_BUSY=4 DIMOS_SOAK_ALL=1 cargo test --locked --test realtime stalls_soak -- --nocapture --test-threads 2
	DIMOS_STALLS=200 cargo test --locked --test realtime stalls:: -- --skip wire_stalls --nocapture --test-threads 1
	DIMOS_WIRE=full cargo test --locked --test realtime wire_stalls -- --nocapture --test-threads 1
