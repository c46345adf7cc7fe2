"""Streams: joint states and events from the run, targets to it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Callable, Optional, Union

from .connection import Connection
from .errors import ConnectionLost, Refused
from .records import ChunkReport, JointState, LoopReport, Pose, joint_state, numbers

IN_FLIGHT = 16  # targets that may wait for their reply
BRAKING = 7.0  # s within which every arm is at rest after a cancel
Policy = Callable[[JointState, float], Optional[Sequence[float]]]  # from joints and time [s] to positions [rad]


class Streams(Connection):
    """A connection that subscribes to streams and sends streams of targets."""

    def __init__(self, path: Union[str, Path], timeout: float = 15.0) -> None:
        super().__init__(path, timeout)
        self._targets: deque[tuple[int, str]] = deque()  # targets that are not answered yet, and their tasks
        self._streams: set[str] = set()  # tasks that took a target of this client

    def joint_states(self, rate: Optional[float] = None) -> Generator[JointState, None, None]:
        """The joints of all arms after every tick, or at `rate` [Hz]. Close the iterator, or leave its loop, to end."""
        return (joint_state(message) for message in self._messages("coordinator_joint_state", rate))

    def events(self) -> Generator[dict[str, Any], None, None]:
        """What happens from now on: `text` for people, `kind`, `level`, `arm`, `task`, `joint` for programs."""
        return (message["data"] for message in self._messages("events", None))

    def servo(self, task: str, positions: Sequence[float], gripper: Optional[float] = None) -> None:
        """Sends a servo task its next target [rad], and the arm's gripper one [m, or rad of a rotary one]. Does not
        wait: a later call, or `settle`, raises a refusal."""
        self._target("servo", {"task": task, "positions": numbers(positions), "gripper": gripper})

    def velocity(self, task: str, velocities: Sequence[float]) -> None:
        """Sends a velocity task its next target [rad/s]; as `servo`."""
        self._target("velocity", {"task": task, "velocities": numbers(velocities)})

    def twist(self, task: str, linear: Sequence[float], angular: Sequence[float], frame: str = "base") -> None:
        """Sends an eef_twist task its next velocity [m/s, rad/s], along the axes of "base" or "tool"; as `servo`."""
        self._target("twist", {"task": task, "linear": numbers(linear), "angular": numbers(angular), "frame": frame})

    def pose(
        self,
        task: str,
        xyz: Sequence[float],
        rpy: Optional[Sequence[float]] = None,
        quat: Optional[Sequence[float]] = None,
    ) -> None:
        """Sends a cartesian_ik task its next pose [m], with `rpy` [rad] or `quat` (x, y, z, w); as `servo`."""
        self._target("pose", {"task": task, **Pose(xyz, rpy, quat).params()})

    def chunk(
        self,
        task: str,
        actions: Sequence[Sequence[float]],
        period: float,
        start: Optional[float] = None,
        gripper: Optional[Sequence[float]] = None,
    ) -> ChunkReport:
        """Sends a chunk task its next horizon: joint positions [rad], `period` [s] apart, the first at `start`, a
        `stamp` of a joint state (default: now), and with each a position of the gripper [m, or rad of a rotary one]. It
        replaces the rest of the chunk before it from its start on."""
        rows = [numbers(action) for action in actions]
        targets = None if gripper is None else numbers(gripper)
        reply = self.call("chunk", task=task, actions=rows, period=period, start=start, gripper=targets)
        self._streams.add(task)
        return ChunkReport(reply["actions"], reply["late"])

    def start(self, task: str) -> None:
        """Starts a task that takes no targets, such as a follow task: its arm approaches the leader's and follows it.
        `cancel(task=…)` ends it; the end of this client does not."""
        self.call("start", task=task)

    def settle(self) -> None:
        """Waits until all targets that were sent are answered; raises the first refusal."""
        while self._targets:
            self._take_answer()

    def _target(self, method: str, params: dict[str, Any]) -> None:
        self._read(0.0)
        while self._targets and (len(self._targets) >= IN_FLIGHT or self._targets[0][0] in self._replies):
            self._take_answer()
        self._targets.append((self._send(method, params), params["task"]))

    def _take_answer(self) -> None:
        number, task = self._targets.popleft()
        self._answer(number)
        self._streams.add(task)

    def follow(self, task: str, policy: Policy, rate: float = 50, duration: Optional[float] = None) -> LoopReport:
        """A policy loop. Calls `policy(state, t)` at `rate` [Hz] with the newest joints of the servo task and the time
        since the start [s], and sends what it returns: the next positions [rad]. None, or `duration` [s], ends it. The
        stream ends with the loop, also after an exception: the arm is at rest when `follow` returns."""
        names: list[str] = next((t["joints"] for t in self.status()["tasks"] if t["name"] == task), [])
        number = self._subscribe("coordinator_joint_state", 2 * rate, 1)
        queue, sent, missed, worst = self._queues[number], 0, 0, 0.0
        try:
            self._await(lambda: queue, self.timeout, "joint state", "is publish_joint_state on?")
            start = beat = time.monotonic()
            while duration is None or beat - start < duration:
                while (now := time.monotonic()) < beat:
                    self._read(beat)  # what comes meanwhile is taken in
                worst = max(worst, now - beat)
                if (target := policy(joint_state(queue[-1]).only(names), beat - start)) is None:
                    break
                self.servo(task, target)
                sent += 1
                beat += 1 / rate
                if (behind := int((time.monotonic() - beat) * rate)) > 0:
                    missed, beat = missed + behind, beat + behind / rate
            seconds = time.monotonic() - start
            self.settle()
        finally:
            with suppress(ConnectionLost):  # its end ends the stream too
                self._end_streams({task})
                self._unsubscribe(number)
        return LoopReport(sent, missed, worst, seconds)

    def _end_streams(self, tasks: set[str]) -> None:
        """Ends the streams of this client to these tasks, and waits until the joints' commands are at rest. Leaves a
        task alone that took no target of this client: its stream is another program's."""
        while self._targets:  # the reply shows whether the task took it
            with suppress(Refused):
                self._take_answer()
        ending = self._streams & tasks
        for task in ending:
            self.call("cancel", task=task)
        self._streams -= ending
        before, deadline = None, time.monotonic() + BRAKING
        while ending and time.monotonic() < deadline:
            state = self.call("state")
            commands = [joint["command"] for arm in state["arms"] for joint in arm["joints"]]
            if before is not None and state["tick"] > before[0] and commands == before[1]:
                return
            if before is None or state["tick"] > before[0]:
                before = (state["tick"], commands)
            time.sleep(0.005)
