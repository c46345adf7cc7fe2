"""Runs the tests with cargo-nextest beside a thread that notices when this computer is stalled.

On a shared host a virtual machine's processors are sometimes taken away for 0.1 s: nothing in it runs, not even a
thread of the highest real-time priority. An arm in motion is held then, as it must be, and the test that watched it
fails, though nothing was wrong. Such a test was interrupted; it has no result yet. It is run again, alone, if the
stall was seen from outside of the test while it ran. A test that fails at any other time has failed.

CI's host is shared, slower on some days, and its stalls of a few milliseconds are not seen. With DIMOS_REPEAT=N a test
that failed is run N times more, alone. It is reported, and counts as passed if it passes each time. More than
FLAKY_MAX such tests are a failure of the suite.
"""

import os
import subprocess
import sys
import threading
import time
import xml.etree.ElementTree as xml
from datetime import datetime

JUNIT = os.path.join(os.environ.get("CARGO_TARGET_DIR", "target"), "nextest", "default", "junit.xml")
# Half of the time between two ticks at which arms are held: a stall is seen in part only, between two wake-ups.
STALL = 0.05
# Without a real-time priority a thread may wait because others run. The processors count as taken away if the
# hypervisor says so for half of the time.
STOLEN = 0.5
ATTEMPTS = 3
FLAKY_MAX = 8


class Stalls(threading.Thread):
    """Wakes up every 10 ms and keeps the times when it could not."""

    def __init__(self):
        super().__init__(daemon=True)
        self.seen = []  # (begin, end) [s since 1970]

    def run(self):
        realtime = self.asks_for_realtime()
        tick = 1.0 / os.sysconf("SC_CLK_TCK")
        before, stolen_before = time.monotonic(), self.stolen()
        while True:
            time.sleep(0.01)
            now, stolen = time.monotonic(), 0 if realtime else self.stolen()
            gap, before = now - before, now
            taken, stolen_before = (stolen - stolen_before) * tick, stolen
            if gap >= STALL and (realtime or taken >= STOLEN * gap):
                end = time.time()
                self.seen.append((end - gap, end))

    @staticmethod
    def asks_for_realtime():
        """Whether this thread, and no process that is started by another, has a real-time priority."""
        try:
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(99))
            return True
        except (OSError, AttributeError):
            return False

    @staticmethod
    def stolen():
        """Time for which the hypervisor ran something else [clock ticks, all processors]."""
        try:
            with open("/proc/stat") as file:
                return int(file.readline().split()[8])
        except (OSError, IndexError):
            return 0

    def while_it_ran(self, begin, end):
        """The longest stall in a span of time [s], or 0."""
        return max((b - a for a, b in list(self.seen) if a < end and b > begin), default=0.0)


def failures():
    """Binary, name, begin and end of each failed test of the last run."""
    for suite in xml.parse(JUNIT).getroot().iter("testsuite"):
        for case in suite.iter("testcase"):
            if case.find("failure") is None and case.find("error") is None:
                continue
            begin = datetime.fromisoformat(case.attrib["timestamp"].replace("Z", "+00:00")).timestamp()
            yield suite.get("name"), case.get("name"), begin, begin + float(case.attrib["time"])


def nextest(arguments):
    features = os.environ.get("FEATURES")
    chosen = ["--features", features] if features else []
    return subprocess.run(["cargo", "nextest", "run", "--workspace", "--locked", *chosen, *arguments]).returncode


def alone(tests):
    """Runs tests one at a time."""
    chosen = " | ".join(f"(binary_id(={binary}) & test(={name}))" for binary, name, _, _ in tests)
    return nextest(["--test-threads", "1", "-E", chosen])


def repeated(stalls, code):
    """The exit code after what a stall interrupted has been run again."""
    for _ in range(ATTEMPTS):
        # 100: tests were run, and some have failed.
        if code != 100 or not os.path.exists(JUNIT):
            break
        failed = list(failures())
        interrupted = [stalls.while_it_ran(begin, end) for _, _, begin, end in failed]
        for (binary, name, _, _), gap in zip(failed, interrupted):
            if gap:
                print(f"INTERRUPTED: {binary} {name}: this computer was stalled for {1000 * gap:.0f} ms")
        if not failed or not all(interrupted):
            break
        print("no result yet; run again, alone:", flush=True)
        code = alone(failed)
    return code


def flaky(code, repetitions):
    """The exit code after what failed has been run some times more."""
    failed = list(failures()) if code == 100 and os.path.exists(JUNIT) else []
    if not failed or not repetitions or len(failed) > FLAKY_MAX:
        return code
    names = [f"{binary} {name}" for binary, name, _, _ in failed]
    for number in range(repetitions):
        print(f"failed; run again, alone ({number + 1} of {repetitions}): {', '.join(names)}", flush=True)
        code = alone(failed)
        if code:
            return code
    for name in names:
        print(f"FLAKY: {name}: failed beside others, and passed {repetitions} times alone")
    return code


def main():
    stalls = Stalls()
    stalls.start()
    if os.path.exists(JUNIT):
        os.remove(JUNIT)
    code = repeated(stalls, nextest(sys.argv[1:]))
    code = flaky(code, int(os.environ.get("DIMOS_REPEAT", "0")))
    longest = max((end - begin for begin, end in stalls.seen), default=0.0)
    if longest:
        print(f"note: this computer was stalled {len(stalls.seen)} times, up to {1000 * longest:.0f} ms")
    return code


if __name__ == "__main__":
    sys.exit(main())
