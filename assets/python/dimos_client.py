"""Talks to a run of dimos: one file, no dependencies, Python 3.9 or newer. Copy it beside your script.

    from dimos_client import Client

    with Client.connect() as robot:                          # the only live run; else Client.connect("its name")
        print(robot.state("arm").position)                   # rad
        robot.move("arm", [0.3, -0.2, 0.5, 0, 0.4, 0])       # waits; not collision-checked
        robot.gripper("arm", "open")

Units are SI: rad, rad/s, Nm, m, N, s. Unknown values are None, never zero. The protocol is in docs/rpc.md.
`call` takes every other request. A client is for one thread; make another for another thread. One connection at a
time may move an arm: LeaseHeld names the other one. Everything that waits has a bound, and so has every queue.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import tempfile
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Deque, Dict, Iterator, List, Optional, Sequence, Union

MAX_LINE = 256 * 1024  # bytes of a request
IN_FLIGHT = 16  # targets that may wait for their reply
Policy = Callable[["JointState", float], Optional[Sequence[float]]]  # from joints and time [s] to positions [rad]
_STALLED = 15.0  # s without progress, after which `wait` cancels a motion
KEPT = 256  # messages of a subscription that wait to be read; older ones are lost and counted


class DimosError(Exception):
    """What went wrong: `code` for programs, `message` and `hint` for people, `data` with the figures."""
    def __init__(self, code: str, message: str, hint: Optional[str] = None, data: Any = None) -> None:
        super().__init__(f"{message} [{code}]" + (f"\nhint: {hint}" if hint else ""))
        self.code, self.message, self.hint, self.data = code, message, hint, data


class NoRun(DimosError): "No run is live, or none of that name, or several and none was named."
class ConnectionLost(DimosError): "The run ended, or does not answer."
class Refused(DimosError): "The run refused a request; the codes are in docs/rpc.md."
class LeaseHeld(Refused): "Another program commands the arm; `data` has its `pid` and `program`."
class ArmNotReady(Refused): "The arm is held, faulted or not enabled: `reset`, then `enable`."
class OutOfLimits(Refused): "A target or the way there leaves a limit; `data` has `joint` and `by`."
class MotionFailed(DimosError): "A motion ended elsewhere than it should; `data` is the reply to `motion`."


_REFUSALS = {"LEASE_HELD": LeaseHeld, "OUT_OF_LIMITS": OutOfLimits}
_REFUSALS.update(dict.fromkeys(("ARM_LATCHED", "ARM_NOT_READY", "STILL_FAULTED"), ArmNotReady))


@dataclass(frozen=True)
class JointState:
    """Joints after a tick, all lists in the order of `name`."""
    tick: int
    stamp: float  # s since 1970
    name: List[str]
    position: List[Optional[float]]  # rad
    velocity: List[Optional[float]]  # rad/s
    effort: List[Optional[float]]  # Nm
    lost: int = 0  # messages that this reader missed just before, because it was too slow

    def only(self, names: Sequence[str]) -> JointState:
        """The same for these joints, in this order."""
        values = ([v[self.name.index(n)] for n in names] for v in (self.position, self.velocity, self.effort))
        return JointState(self.tick, self.stamp, list(names), *values, self.lost)


@dataclass(frozen=True)
class ArmState(JointState):
    """An arm after a tick."""
    age: Optional[float] = None  # s, of its joints
    gripper: Optional[float] = None  # m of opening, or rad of a rotary jaw
    xyz: Optional[List[float]] = None  # m, end effector in the base frame
    rpy: Optional[List[float]] = None  # rad, fixed axes
    wrench: Optional[List[float]] = None  # N, N, N, Nm, Nm, Nm
    gripper_unit: Optional[str] = None  # "m" or "rad"
    gripper_force: Optional[float] = None  # measured, in gripper_force_unit
    gripper_force_unit: Optional[str] = None  # "N" or "Nm"


@dataclass(frozen=True)
class LoopReport:
    """How a policy loop kept its time."""
    sent: int  # targets that the run took
    missed: int  # beats that were missed because the policy or the computer took longer than a period
    worst: float  # s, the latest start of a beat
    seconds: float  # s, how long the loop ran


def runs() -> Dict[str, Path]:
    """The sockets of the live runs, by name, where the command line looks for them."""
    base = os.environ.get("XDG_RUNTIME_DIR", "")
    folder = Path(base, "dimos") if os.path.isdir(base) else Path(tempfile.gettempdir(), f"dimos-{os.geteuid()}")
    live = {}
    for lock in sorted(folder.glob("*.lock")):
        try:
            with open(lock) as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # what is not locked is what a dead run left
        except BlockingIOError:
            live[lock.stem] = lock.with_suffix(".sock")
        except OSError:
            pass
    return live


class Client:
    """A connection to a run."""
    def __init__(self, path: Union[str, Path], timeout: float = 15.0) -> None:
        """Connects to a socket. `timeout` [s] bounds every wait for the run."""
        self.timeout, self._next_id, self._unread, self._replies = timeout, 0, b"", {}
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise ConnectionLost("NO_CONNECTION", f"{path}: {error}", "see `dimos status`") from None
        self._targets: Deque[int] = deque()  # ids of targets that are not answered yet
        self._queues: Dict[int, Deque[Dict[str, Any]]] = {}

    @classmethod
    def connect(cls, run: Optional[str] = None, timeout: float = 15.0) -> Client:
        """Connects to the run of a name or, without one, to the only live run."""
        live = runs()
        if run is None and len(live) > 1:
            raise NoRun("SEVERAL_RUNS", f"several runs are live: {', '.join(live)}", "say which")
        if not live or run not in (None, *live):
            raise NoRun("NO_RUN", f"no run is live{f' by the name of {run}' if run else ''}", "start one: dimos run")
        return cls(live[run or next(iter(live))], timeout)

    def close(self) -> None:
        """Ends the connection and what it leases. A motion that has begun continues; a stream goes stale."""
        self._socket.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(self, method: str, **params: Any) -> Dict[str, Any]:
        """Any request of docs/rpc.md: its `result`. Raises Refused."""
        return self._answer(self._send(method, params))

    def _send(self, method: str, params: Dict[str, Any]) -> int:
        self._next_id += 1
        params = {key: value for key, value in params.items() if value is not None}
        try:
            request = json.dumps({"id": self._next_id, "method": method, "params": params}, allow_nan=False)
        except ValueError as error:
            raise Refused("INVALID_PARAMS", f"{method}: {error}", "all numbers must be finite") from None
        if len(line := request.encode() + b"\n") > MAX_LINE:
            raise Refused("TOO_LARGE", f"the request has {len(line)} bytes, and may have {MAX_LINE}")
        try:
            self._socket.settimeout(self.timeout)
            self._socket.sendall(line)
        except OSError as error:
            raise ConnectionLost("NO_CONNECTION", f"the run is gone: {error}") from None
        return self._next_id

    def _answer(self, number: int) -> Dict[str, Any]:
        self._await(lambda: number in self._replies, self.timeout, "answer", "`dimos status` may say why")
        reply = self._replies.pop(number)
        if "error" in reply:
            error = reply["error"]
            raise _REFUSALS.get(error["code"], Refused)(*map(error.get, ("code", "message", "hint", "data")))
        return reply["result"]

    def _await(self, ready: Callable[[], Any], limit: float, what: str, hint: str) -> None:
        """Takes in what the run says until `ready`, at most for `limit` [s]; then raises ConnectionLost."""
        deadline = time.monotonic() + limit
        while not ready():
            if not self._read(deadline) or time.monotonic() > deadline and not ready():
                raise ConnectionLost("NO_ANSWER", f"no {what} within {limit} s", hint)

    def _read(self, deadline: float) -> bool:
        """Takes in what the run says next; False when nothing came until `deadline` (monotonic) [s]."""
        try:
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-6))
            chunk = self._socket.recv(1 << 16)
        except (socket.timeout, BlockingIOError):
            return False
        except OSError as error:
            raise ConnectionLost("NO_CONNECTION", f"the run is gone: {error}") from None
        if not chunk:
            raise ConnectionLost("NO_CONNECTION", "the run closed the connection", "it may have ended: `dimos status`")
        *lines, self._unread = (self._unread + chunk).split(b"\n")
        for message in map(json.loads, lines):
            if "stream" in message:
                queue = self._queues.get(message["subscription"])
                if queue is not None:
                    dropped = queue.popleft() if len(queue) == queue.maxlen else None
                    queue.append(message)
                    if dropped:
                        queue[0]["lost"] = queue[0].get("lost", 0) + dropped.get("lost", 0) + 1
            elif message["id"] is None:  # it speaks of the connection, which it closes
                error = message["error"]
                raise ConnectionLost(error["code"], error["message"], error.get("hint"))
            else:
                self._replies[message["id"]] = message
        return True

    def _subscribe(self, stream: str, rate: Optional[float], kept: int) -> int:
        number = self.call("subscribe", stream=stream, rate=rate)["subscription"]
        self._queues[number] = deque(maxlen=kept)
        return number

    def _unsubscribe(self, number: int) -> None:
        del self._queues[number]
        if self._socket.fileno() >= 0:  # an iterator may outlive its connection
            self.call("unsubscribe", subscription=number)

    def _messages(self, stream: str, rate: Optional[float]) -> Iterator[Dict[str, Any]]:
        number = self._subscribe(stream, rate, KEPT)
        try:
            while True:
                while stream == "events" and not self._queues[number]:  # the run may be silent, but answers
                    self._read(time.monotonic() + self.timeout) or self.status()
                limit = self.timeout + (1 / rate if rate else 0)
                self._await(lambda: self._queues[number], limit, "joint state", "is publish_joint_state on?")
                yield self._queues[number].popleft()
        finally:
            self._unsubscribe(number)

    def status(self) -> Dict[str, Any]:
        """Arms, tasks, timing, recorder, as docs/rpc.md says."""
        return self.call("status")

    def state(self, arm: str) -> ArmState:
        """The latest state of an arm."""
        reply = self.call("state")
        if (found := next((a for a in reply["arms"] if a["hardware_id"] == arm), None)) is None:
            raise Refused("UNKNOWN_ARM", f"no arm named {arm}", "`dimos status` lists the arms")
        values = [[j[key] for j in found["joints"]] for key in ("name", "position", "velocity", "effort")]
        pose, age = found["pose"] or {}, found["age_ms"]
        more = (age and age / 1000, found["gripper"], pose.get("xyz"), pose.get("rpy"), found["wrench"])
        grip = (found.get(key) for key in ("gripper_unit", "gripper_force", "gripper_force_unit"))
        return ArmState(reply["tick"], reply["stamp"], *values, 0, *more, *grip)

    def joint_states(self, rate: Optional[float] = None) -> Iterator[JointState]:
        """The joints of all arms after every tick, or at `rate` [Hz]. Close the iterator, or leave its loop, to end."""
        for message in self._messages("coordinator_joint_state", rate):
            yield _joint_state(message)

    def events(self) -> Iterator[Dict[str, Any]]:
        """What happens: `text` for people, `kind`, `level`, `arm`, `task`, `joint` for programs."""
        for message in self._messages("events", None):
            yield message["data"]

    def move(self, arm: str, target: Sequence[float], speed: float = 0.5, wait: bool = True) -> Dict[str, Any]:
        """Moves an arm to `target` [rad], directly: not collision-checked. `speed`: 0.01–1 of its limits."""
        begun = self.call("move", arm=arm, target=list(target), speed=speed)
        return self.wait(begun["motion"]) if wait else begun

    def execute(self, trajectory: Dict[str, Any], task: Optional[str] = None, wait: bool = True) -> Dict[str, Any]:
        """Follows a trajectory: joint_names, and points of time_from_start [s], positions [rad], velocities [rad/s]."""
        begun = self.call("execute", trajectory=trajectory, task=task)
        return self.wait(begun["motion"]) if wait else begun

    def wait(self, motion: int) -> Dict[str, Any]:
        """Waits for a motion's end. Ctrl-C cancels it, and so do 15 s without progress. Raises MotionFailed when it
        ended elsewhere than it should, or made no progress."""
        report, elapsed, deadline = self.call("motion", motion=motion), None, 0.0
        try:
            while not report["done"]:
                if report["elapsed"] != elapsed or report.get("replanning"):
                    elapsed, deadline = report["elapsed"], time.monotonic() + _STALLED
                elif time.monotonic() > deadline:
                    raise MotionFailed(report["state"], f"no progress within {_STALLED} s: cancelled", data=report)
                time.sleep(0.02)
                report = self.call("motion", motion=motion)
        except (KeyboardInterrupt, MotionFailed):
            self.cancel(task=report["task"])
            raise
        if report["state"] != "COMPLETED":
            raise MotionFailed(report["state"], report["error"] or "it ended before its goal", data=report)
        return report

    def servo(self, task: str, positions: Sequence[float]) -> None:
        """Sends a servo task its next target [rad]. Does not wait: a later call, or `settle`, raises a refusal."""
        self._target("servo", {"task": task, "positions": list(positions)})

    def velocity(self, task: str, velocities: Sequence[float]) -> None:
        """Sends a velocity task its next target [rad/s]; as `servo`."""
        self._target("velocity", {"task": task, "velocities": list(velocities)})

    def twist(self, task: str, linear: Sequence[float], angular: Sequence[float], frame: str = "base") -> None:
        """Sends an eef_twist task its next velocity [m/s, rad/s], along the axes of "base" or "tool"; as `servo`."""
        self._target("twist", {"task": task, "linear": list(linear), "angular": list(angular), "frame": frame})

    def pose(self, task: str, xyz: Sequence[float], **turn: Sequence[float]) -> None:
        """Sends a cartesian_ik task its next pose [m], with `rpy=` [rad] or `quat=` (x, y, z, w); as `servo`."""
        self._target("pose", {"task": task, "xyz": list(xyz), **{key: list(turn[key]) for key in turn}})

    def _target(self, method: str, params: Dict[str, Any]) -> None:
        self._read(0.0)
        while self._targets and (len(self._targets) >= IN_FLIGHT or self._targets[0] in self._replies):
            self._answer(self._targets.popleft())
        self._targets.append(self._send(method, params))

    def settle(self) -> None:
        """Waits until all targets that were sent are answered; raises the first refusal."""
        while self._targets:
            self._answer(self._targets.popleft())

    def follow(self, task: str, policy: Policy, rate: float = 50, duration: Optional[float] = None) -> LoopReport:
        """A policy loop. Calls `policy(state, t)` at `rate` [Hz] with the newest joints of the servo task and the time
        since the start [s], and sends what it returns: the next positions [rad]. None, or `duration` [s], ends it."""
        names = next((t["joints"] for t in self.status()["tasks"] if t["name"] == task), [])
        number = self._subscribe("coordinator_joint_state", 2 * rate, 1)
        queue, sent, missed, worst = self._queues[number], 0, 0, 0.0
        try:
            self._await(lambda: queue, self.timeout, "joint state", "is publish_joint_state on?")
            start = beat = time.monotonic()
            while duration is None or beat - start < duration:
                while (now := time.monotonic()) < beat:
                    self._read(beat)  # what comes meanwhile is taken in
                worst = max(worst, now - beat)
                if (target := policy(_joint_state(queue[-1]).only(names), beat - start)) is None:
                    break
                self.servo(task, target)
                sent += 1
                beat += 1 / rate
                if (behind := int((time.monotonic() - beat) * rate)) > 0:
                    missed, beat = missed + behind, beat + behind / rate
            self.settle()
        finally:
            self._unsubscribe(number)
        return LoopReport(sent, missed, worst, time.monotonic() - start)

    def gripper(self, arm: str, opening: Union[float, str], force: Optional[float] = None) -> None:
        """Moves a gripper to a position (an opening [m], or the angle [rad] of a rotary one), to "open" or "close", with a
        largest `force` (unit and range are in `status`) if it has force control."""
        if opening in ("open", "close"):
            found = next((a for a in self.status()["arms"] if a["hardware_id"] == arm), {})
            if found.get("gripper_range") is None:
                raise Refused("UNSUPPORTED", f"{arm} does not say how far it opens", "give a number")
            opening = found["gripper_range"][opening == "open"]
        self.call("gripper", arm=arm, position=opening, force=force)

    def io(self, arm: str) -> Dict[str, Any]:
        """Digital and analogue inputs and outputs of an arm, as docs/rpc.md says."""
        return self.call("arm_io", arm=arm)

    def set_io(self, arm: str, **outputs: float) -> Dict[str, Any]:
        """Sets outputs, `do3=1` or `ao0=2.5`; the levels that are read back."""
        return self.call("arm_io_set", arm=arm, outputs=outputs)

    def payload(self, arm: str) -> Optional[Dict[str, Any]]:
        """The load at the flange that the controller reports: mass [kg], center [m], inertia [kg·m²]."""
        return self.call("arm_payload", arm=arm)["payload"]

    def set_payload(self, arm: str, mass: float, center: Sequence[float] = (0, 0, 0)) -> Optional[Dict[str, Any]]:
        """Sets the load of everything at the flange [kg, m], at rest; what the controller then reports."""
        return self.call("arm_payload_set", arm=arm, mass=mass, center=list(center))["payload"]

    def cancel(self, arm: Optional[str] = None, task: Optional[str] = None) -> Dict[str, str]:
        """Ends motions by decelerating: of an arm, of a task, or all."""
        return self.call("cancel", arm=arm, task=task)["tasks"]

    def stop(self, arm: Optional[str] = None) -> Dict[str, str]:
        """Latched hold at once, of an arm or of all: an operational stop. Per arm `confirmed`, or not."""
        return self.call("stop", arm=arm)["arms"]

    def reset(self, arm: str) -> str:
        """Clears a latched hold or a fault. Moves nothing, enables nothing. The arm's phase."""
        return self.call("arm_reset", arm=arm)["phase"]

    def enable(self, arm: str) -> str:
        """Enables the motors and makes the arm ready, where it is. The arm's phase."""
        return self.call("arm_enable", arm=arm)["phase"]


def _joint_state(message: Dict[str, Any]) -> JointState:
    values = map(message["data"].get, ("tick", "stamp", "name", "position", "velocity", "effort"))
    return JointState(*values, message.get("lost", 0))
