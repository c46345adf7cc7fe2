"""Serves a Python arm adapter, one with the guide's methods, to dimos (`adapter_type: remote`):

    python3 dimos_shim.py yourmodule:YourArmAdapter --address 192.168.1.100 --at unix:/run/user/1000/arm.sock

docs/remote-adapter.md has the protocol.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import enum
import errno
import importlib
import inspect
import itertools
import json
import math
import os
import pathlib
import platform
import select
import signal
import socket
import statistics
import struct
import sys
import time
from collections.abc import Sequence
from typing import Any, Callable, Optional

SILENCE, LONGEST = 0.5, 16384  # a commanded arm is stopped after this time without a request [s]; bytes of a line
FEEDBACK = ["read_joint_velocities", "read_joint_efforts"]
EXTRAS = ["modes", "gripper_range", "gripper_unit", "holds_when_disabled", "gap_tolerance", "after_gap", "impedance"]
# Parameters that `write_setpoint` of an adapter may have besides `position` and `mode`: their names in a command.
FIELDS = {
    "velocity": "velocities",
    "acceleration": "accelerations",
    "effort": "efforts",
    "stiffness": "stiffness",
    "damping": "damping",
    "at": "at",
    "expires": "valid",
}
# What more an adapter may know of a state: its method, its name in the state.
MORE = {"missing_joints": "missing", "read_device_time": "device_time"}
READS = [
    "read_error",
    "read_enabled",
    "get_control_mode",
    "read_state",
    "read_gripper_position",
    "read_cartesian_position",
    "read_force_torque",
    *FEEDBACK,
]
ACTS = ["activate", "deactivate", "write_enable", "set_control_mode", "write_stop", "write_clear_errors"]
MOTIONS = ["write_gripper_position", "write_cartesian_position"]
# For adapters without these methods.
INSTEAD: dict[str, tuple[str, tuple[Any, ...]]] = {
    "activate": ("write_enable", (True,)),
    "deactivate": ("write_stop", ()),
}
DISABLED, MISSING = "it stopped on its own or is not enabled: enable it first", (ModuleNotFoundError, AttributeError)


# Of dimos; objects replace what adapters of the guide import from it and it lacks, or all of it.
def control_modes() -> Any:
    name, bag = "dimos.hardware.manipulators", argparse.Namespace
    with contextlib.suppress(ImportError):
        vars(spec := importlib.import_module(name + ".spec")).setdefault("JointLimits", bag)  # elsewhere since 0.0.15
        return spec.ControlMode
    modes = ["position", "servo_position", "velocity", "torque", "cartesian", "cartesian_velocity", "impedance"]
    lacking: Any = bag(
        ControlMode=enum.Enum("ControlMode", {mode.upper(): mode for mode in modes}),
        ManipulatorInfo=bag,
        JointLimits=bag,
        ManipulatorAdapter=object,
        AdapterRegistry=object,
    )
    sys.modules.update(dict.fromkeys(["dimos", "dimos.hardware", name, name + ".spec", name + ".registry"], lacking))
    return lacking.ControlMode


class Arm:  # the adapter, called from one thread only
    def __init__(self, adapter: Any, modes: Any, dof: Optional[int], hz: float) -> None:
        self.adapter, self.modes, self.hz, self.rate = adapter, modes, hz, hz
        takes = inspect.signature(getattr(adapter, "write_setpoint", lambda: None)).parameters
        every = any(parameter.kind is parameter.VAR_KEYWORD for parameter in takes.values())
        self.takes = [name for name in [*FIELDS, "mode"] if every or name in takes]
        self.follows = bool(takes)
        self.cycles: list[float] = []  # durations of the last ones with a command [s]
        self.news, self.reads, self.since = 0, 0, time.monotonic()
        self.state: dict[str, Any] = {}
        self.measured: set[str] = set()
        self.commanded, self.held, self.turns, self.due = False, True, itertools.cycle(READS[:-2]), 0.0
        self.call("connect")
        self.dof, began = dof or adapter.get_dof(), time.monotonic()
        self.read(*READS)
        self.quick = time.monotonic() - began < 0.5 / hz  # else one read besides the positions per cycle, in turn
        self.measure()

    def measure(self) -> None:  # how many states per second the SDK can deliver
        spent = []
        for _ in range(3):
            began = time.monotonic()
            try:
                self.read("read_joint_positions", *(READS if self.quick else [next(self.turns)]))
            except Exception:
                return  # the run that connects reports it
            spent.append(time.monotonic() - began)
        self.slower(1.0 / max(statistics.median(spent), 1e-6), "its calls take that long")

    def slower(self, rate: float, why: str) -> None:
        if rate < 0.9 * self.rate:
            self.rate = max(rate, 0.1)
            said = f"the arm delivers {self.rate:.1f} states per second instead of {self.hz:g}: {why}"
            print(f"{said}; --hz {max(math.floor(self.rate), 1)} says so from the start", flush=True)

    def watch(self, before: Any, began: float, commanded: bool) -> None:  # the rate while the arm is commanded
        now = time.monotonic()
        self.cycles = [*self.cycles[-19:], now - began] if commanded else []
        if len(self.cycles) == 20:
            self.slower(1.0 / max(statistics.median(self.cycles), 1e-6), "its calls take that long")
        self.news, self.reads = self.news + (self.state["read_joint_positions"] != before), self.reads + 1
        if now - self.since >= 2.0:
            if self.news >= 10 and self.news < 0.6 * self.reads:  # it moved, and most reads brought nothing new
                self.slower(self.news / (now - self.since), "its SDK has no newer ones")
            self.news, self.reads, self.since = 0, 0, now

    def lost(self) -> bool:
        return hasattr(self.adapter, "is_connected") and not self.adapter.is_connected()

    def read(self, *names: str) -> None:  # only zeros since the start: the guide's sign for "not measured"
        for name, answer in [(name, getattr(self.adapter, name)()) for name in names if hasattr(self.adapter, name)]:
            if name.startswith("read_joint_") and answer is not None:
                odd = [f"{value} for joint {i}" for i, value in enumerate(answer, 1) if not math.isfinite(value)]
                if len(answer) != self.dof:
                    odd = [f"{len(answer)} values for {self.dof} joints"]
                if odd:
                    raise ValueError(f"{name}() answers {odd[0]}")
                if any(answer):
                    self.measured.add(name)
            self.state[name] = answer

    def call(self, name: str, *args: Any, **more: Any) -> None:
        name, args = (name, args) if hasattr(self.adapter, name) else INSTEAD.get(name, (name, args))
        answer = getattr(self.adapter, name)(*args, **more)
        if answer is not None and not answer:
            code, text = (0, "") if self.lost() else self.adapter.read_error()
            raise RuntimeError(f"{name}() said no" + (f" (error {code}: {text})" if code else ""))

    def hello(self, version: int = 1, **_: Any) -> dict[str, Any]:
        self.held = True
        if self.lost():
            self.call("connect")
        return {
            "version": min(version, 2),
            "dof": self.dof,
            "native_rate": self.rate,
            "asked_rate": self.hz if self.rate < self.hz else None,
            "fields": [name for name in self.takes if name in FIELDS],
            "effort_kind": getattr(self.adapter, "effort_kind", None),
            "info": vars(self.adapter.get_info()),
            "limits": vars(self.adapter.get_limits()),
            "parts": [k for k, v in self.state.items() if v is not None],
            **{k: getattr(self.adapter, k, None) for k in EXTRAS},
        }

    def act(self, do: str, args: Sequence[Any] = ()) -> None:
        if do not in ACTS + MOTIONS or (self.held and do in MOTIONS):
            raise RuntimeError(DISABLED if do in MOTIONS else f"{do} is not for clients")
        self.commanded |= do == "write_cartesian_position"
        if do == "write_stop":
            args = ()  # the guide's has no point of rest
        self.call(do, *([self.modes[args[0].upper()]] if do == "set_control_mode" else args))
        if do in ("activate", "write_enable"):
            self.held = not (do == "activate" or args[0])
        self.commanded, self.due = self.commanded and do not in ("write_stop", "deactivate") and not self.held, 0.0
        self.read("read_error", "read_enabled", "get_control_mode")

    def stop(self, why: str) -> None:
        self.held, how = True, ""
        try:
            self.call("write_stop")
            self.commanded = False
        except Exception as e:
            how = f", which failed and will be retried: {e!r}"
        print(f"{why}: stopping the arm{how}", flush=True)

    # One command, one reading, timed when the SDK returned the positions.
    def cycle(self, command: Optional[dict[str, Any]] = None) -> dict[str, Any]:
        refused, began = DISABLED if command and self.held else None, time.monotonic()
        if command and not refused:
            self.commanded = True
            try:
                self.command(**command)
            except Exception as e:
                refused = str(e) or repr(e)
        time.sleep(0.0 if command else max(0.0, self.due - time.monotonic()))  # asked early: wait for a new state
        if time.monotonic() >= self.due:
            before = self.state.get("read_joint_positions")
            self.read("read_joint_positions")
            self.state["time"], self.due = time.monotonic_ns(), time.monotonic() + 0.5 / self.hz
            self.read(*READS if self.quick else [next(self.turns)])
            self.state.update({k: getattr(self.adapter, m)() for m, k in MORE.items() if hasattr(self.adapter, m)})
            self.watch(before, began, command is not None)
        unknown = [name for name in FEEDBACK if not self.quick or name not in self.measured]
        return {"state": {**self.state, "held": self.held, **dict.fromkeys(unknown)}, "refused": refused}

    def command(self, mode: str, values: list[float], velocity: float, **more: Any) -> None:
        if mode == "velocity":
            self.call("write_joint_velocities", values)
        elif mode == "position" or not self.follows:
            self.call("write_joint_positions", values, velocity)
        else:  # what is not commanded is None, never zero
            given = {name: more.get(FIELDS[name]) for name in self.takes if name in FIELDS}
            if "mode" in self.takes:
                given["mode"] = self.modes[mode.upper()]
            self.call("write_setpoint", position=values, **given)

    def reply(self, line: bytes) -> bytes:
        request = json.loads(line)
        methods: dict[str, Callable[..., dict[str, Any]]] = {"hello": self.hello, "cycle": self.cycle}
        id, method = request.pop("id"), methods.get(request["do"])
        try:
            if method:
                content = method(**{k: v for k, v in request.items() if k != "do"})
            else:
                self.act(**request)
                content = {}
            return json.dumps({"id": id, **content}, allow_nan=False, default=plain).encode() + b"\n"
        except Exception as e:
            error = "not_connected" if self.lost() else "io" if method else "rejected"
            return json.dumps({"id": id, "error": error, "text": (str(e) or repr(e))[:1000]}).encode() + b"\n"


def plain(value: Any) -> Any:
    return value.value if isinstance(value, enum.Enum) else value.tolist()  # numpy has that


def serve(arm: Arm, listener: socket.socket) -> None:
    client: Optional[socket.socket] = None
    data, heard = b"", 0.0
    while True:
        ready = select.select([listener, client] if client else [listener], [], [], SILENCE / 5)[0]
        if client and client in ready:
            try:
                arrived = client.recv(LONGEST)
                *lines, data = (data + arrived).split(b"\n")
                if not arrived or len(data) > LONGEST:
                    raise OSError("a line without end" if arrived else "closed")
                for line in lines:
                    client.sendall(arm.reply(line))
                heard = time.monotonic()
            except Exception as e:  # it disconnected, or uses another protocol
                client.close()
                client, data = None, b""
                if arm.commanded:
                    arm.stop(f"the client's connection ended ({e!r})")
        if arm.commanded and time.monotonic() - heard >= SILENCE:
            arm.stop(f"no request came for {SILENCE} s")
        if listener in ready:
            with contextlib.suppress(OSError):  # the client may have disconnected already
                another = listener.accept()[0]
                another.settimeout(1.0)
                if listener.family == socket.AF_INET and not is_ours(another):
                    another.close()
                elif client:
                    another.sendall(b'{"id":1,"error":"rejected","text":"it serves another client already"}\n')
                else:
                    client = another


# Any user can connect to a port; the system lists whose an open connection's other end is.
def is_ours(client: socket.socket) -> bool:
    def at(ip: str, port: int) -> str:
        return f"{int.from_bytes(socket.inet_aton(ip), sys.byteorder):08X}:{port:04X}"

    ends = [at(*client.getpeername()), at(*client.getsockname()), "01"]
    rows = map(str.split, pathlib.Path("/proc/net/tcp").read_text().splitlines())
    return any(row[1:4] == ends and row[9] != "0" and int(row[7]) in (0, os.geteuid()) for row in rows)


def listen(at: str) -> socket.socket:
    if not at.startswith("unix:"):
        host, _, port = at.replace("tcp:", "", 1).rpartition(":")
        if not host.startswith("127.") or not port.isdigit():
            raise OSError("not a loopback address or unix:/PATH")
        return socket.create_server((host, int(port)))
    refused = socket.socket(socket.AF_UNIX).connect_ex(at[5:]) == errno.ECONNREFUSED  # by a shim that is gone
    if refused and pathlib.Path(at[5:]).is_socket():
        os.unlink(at[5:])
    before = os.umask(0o177)  # the socket is for this user only; files and folders of the adapter are as usual
    try:
        return socket.create_server(at[5:], family=socket.AF_UNIX)
    finally:
        os.umask(before)


def ask_for_short_slices() -> None:  # since Linux 6.12 a thread that asks for them runs sooner beside busy programs
    number = {"x86_64": 314, "aarch64": 274}.get(platform.machine())  # of the system call sched_setattr
    if number and sys.platform == "linux":  # size, ordinary class, flags, nice, priority, slice of 0.1 ms
        attr = struct.pack("=IIQiIQQQ", 48, 0, 0, os.getpriority(os.PRIO_PROCESS, 0), 0, 100_000, 0, 0)
        ctypes.CDLL(None).syscall(number, 0, attr, 0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("adapter", help="MODULE:CLASS")
    parser.add_argument("--at", required=True, help="where dimos connects: unix:/PATH or tcp:127.0.0.1:PORT")
    parser.add_argument("--address", default=argparse.SUPPRESS, help="given to the adapter")
    parser.add_argument("--dof", type=int, default=argparse.SUPPRESS, help="given to the adapter")
    parser.add_argument("--hz", type=float, default=100.0, help="how often the arm has a new state (100)")
    adapter, at, hz = map((given := vars(parser.parse_args())).pop, ("adapter", "at", "hz"))
    for end in signal.SIGINT, signal.SIGTERM, signal.SIGHUP:
        signal.signal(end, lambda *_: sys.exit(0))
    sys.path.insert(0, os.getcwd())
    ask_for_short_slices()
    try:
        (module, _, name), modes, listener = adapter.partition(":"), control_modes(), listen(at)
        arm = Arm(getattr(importlib.import_module(module), name)(**given), modes, given.get("dof"), hz)
    except Exception as e:
        hint = "\nhint: give MODULE:CLASS, a class in a file here or on PYTHONPATH" if type(e) in MISSING else ""
        sys.exit(f"error: {adapter} --at {at}: {str(e) or repr(e)}{hint}")
    print(f"serving {adapter} at {at}; Ctrl-C ends it", flush=True)
    try:
        serve(arm, listener)
    finally:  # a signal, or an error in this file
        if arm.commanded:
            arm.stop("the shim exits")
        arm.adapter.disconnect()
