"""A run as Python dimos sees it: its joints, arms and tasks under their names, and the calls of a coordinator."""

# mypy: disable-error-code="import-untyped"
from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Sequence
from typing import Any, Callable, ClassVar, Optional

from dimos.control.tasks.trajectory_task import trajectory_task as theirs
from dimos.msgs.trajectory_msgs.JointTrajectory import JointTrajectory
from dimos.msgs.trajectory_msgs.TrajectoryStatus import TrajectoryState, TrajectoryStatus

from .client import Client
from .errors import ConnectionLost, DimosError, Refused

TASK = "joint_trajectory"  # the one trajectory task that Python dimos knows
GRIPPER = "_gripper"  # end of the name of an arm's gripper task
MAX_POINTS = 20_000  # of a trajectory
STALE_AFTER, LEASE_KEPT = 0.5, 1.0  # s
NOT_ALLOWED = "this run takes no commands from Python dimos: start its bridge with --command"
EXECUTION = theirs.TrajectoryExecutionStatus
CANCELLATION = theirs.TrajectoryCancellationStatus


class Names:
    """Joints, arms and tasks of a run, with the names of Python dimos."""

    def __init__(self, client: Client, given: dict[str, str]) -> None:
        state, status = client.call("state"), client.status()
        self.theirs: dict[str, str] = {}
        for arm in state["arms"]:
            for joint in (joint["name"] for joint in arm["joints"]):
                self.theirs[joint] = given.pop(joint, "") or of_joint(joint, arm["hardware_id"])
        if given:
            raise SystemExit(f"error: --joint: no joint of the run is named {', '.join(given)}")
        self.ours = {name: joint for joint, name in self.theirs.items()}
        if len(self.ours) < len(self.theirs):
            raise SystemExit("error: --joint: two joints would have the same name")
        self.arms: list[str] = [arm["hardware_id"] for arm in state["arms"]]
        ranges = {arm["hardware_id"]: arm.get("gripper_range") for arm in status["arms"]}
        self.grippers: dict[str, Optional[list[float]]] = {
            arm["hardware_id"] + GRIPPER: ranges[arm["hardware_id"]] for arm in state["arms"] if arm.get("gripper_unit")
        }
        self.trajectory_tasks: list[str] = [t["name"] for t in status["tasks"] if "execute" in t["takes"]]


def of_joint(joint: str, arm: str) -> str:
    """`PREFIX_jointN` is `PREFIX/jointN`; any other name is below that of its arm."""
    prefix, _, number = joint.rpartition("_joint")
    return f"{prefix}/joint{number}" if prefix and number.isdigit() else f"{arm}/{joint}"


class Link:
    """A connection that is made when it is needed, and used by one thread at a time."""

    def __init__(self, connect: Callable[[], Client]) -> None:
        self.connect, self.lock = connect, threading.RLock()
        self.client: Optional[Client] = None
        self.used = 0.0

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        with self.lock:
            if self.client is not None and time.monotonic() - self.used > LEASE_KEPT:
                self.close()  # the run may have closed it in favour of others
            self.used = time.monotonic()
            self.client = self.client or self.connect()
            try:
                return self.client.call(method, **params)
            except ConnectionLost:
                self.close()
                raise

    def close(self) -> None:
        with self.lock:
            if self.client is not None:
                self.client.close()
                self.client = None


class Coordinator:
    """The methods of a `ControlCoordinator`, by their names. A cancellation waits for no trajectory that is checked."""

    def __init__(self, connect: Callable[[bool], Client], joints: dict[str, str], command: bool) -> None:
        self.reads, self.ends = Link(lambda: connect(False)), Link(lambda: connect(False))
        self.moves = Link(lambda: connect(True))
        with connect(False) as client:
            self.names = Names(client, joints)
        self.command, self.ended = command, 0
        self.motion: Optional[int] = None
        self.newest: Optional[tuple[float, Any]] = None
        self.tasks: dict[str, Any] = {name: GripperTask(self, name) for name in self.names.grippers}
        if self.names.trajectory_tasks:
            self.tasks = {TASK: TrajectoryTask(self), **self.tasks}

    def list_joints(self) -> list[str]:
        return list(self.names.ours)

    def list_hardware(self) -> list[str]:
        return self.names.arms

    def list_tasks(self) -> list[str]:
        return list(self.tasks)

    def get_active_tasks(self) -> list[str]:
        moving = TASK in self.tasks and self.tasks[TASK].get_state() is TrajectoryState.EXECUTING
        return [TASK] * moving + list(self.names.grippers)  # to Python dimos a gripper's task is always active

    def get_joint_positions(self) -> dict[str, float]:
        if self.newest and time.monotonic() - self.newest[0] < STALE_AFTER:
            return dict(zip(self.newest[1].name, self.newest[1].position))
        joints = (joint for arm in self.reads.call("state")["arms"] for joint in arm["joints"])
        return {self.names.theirs[j["name"]]: j["position"] for j in joints if j["position"] is not None}

    def get_tick_count(self) -> int:
        return int(self.newest[1].tick) if self.newest else 0

    def get_skills(self) -> list[Any]:
        return []

    def build(self) -> None:
        """Nothing: a program elsewhere neither begins nor ends a run."""

    start = stop = build

    def reset_runtime_state(self, reactivate: bool = True) -> dict[str, Any]:
        return {}

    def describe_task(self, task_name: str) -> Any:
        if (task := self.tasks.get(task_name)) is None:
            return None
        commands = {name: inspect.signature(getattr(task, name)) for name in task.COMMANDS}
        described = {name: {"signature": str(of), "params": list(of.parameters)} for name, of in commands.items()}
        return {"task": task_name, "commands": described, "streams": []}

    def task_invoke(self, task_name: str, method: str, kwargs: Optional[dict[str, Any]] = None) -> Any:
        if (task := self.tasks.get(task_name)) is None:
            return None
        where = f"task_invoke({task_name!r}, {str(method)[:80]!r})"
        if method not in task.COMMANDS:
            raise AttributeError(f"{where}: task has no such method; declared commands: {task.COMMANDS}")
        accepted = inspect.signature(getattr(task, method)).parameters
        if unexpected := [name for name in kwargs or {} if name not in accepted]:
            raise TypeError(f"{where}: unexpected argument(s) {unexpected}; accepts {list(accepted)}")
        return getattr(task, method)(**(kwargs or {}))

    def execute_trajectory(self, trajectory: Any) -> Any:
        return TrajectoryTask(self).execute(trajectory, None)

    def cancel_trajectory(self) -> Any:
        return TrajectoryTask(self).cancel()

    def set_estop(self, estopped: bool) -> bool:
        if not estopped:
            way = "; ".join(f"dimos arm {verb} {arm}" for verb in ("reset", "enable") for arm in self.names.arms)
            raise RuntimeError(f"a stop is cleared by a person, in sight of the arm, on the run's computer: {way}")
        self.ended += 1
        stopped = self.ends.call("stop")["arms"]
        if unconfirmed := [f"{arm}: {answer}" for arm, answer in stopped.items() if answer != "confirmed"]:
            raise RuntimeError("; ".join(unconfirmed))
        return True

    def free_lease(self) -> None:
        """Closes the connection that commands a while after its motion: the lease is that of the connection."""
        with self.moves.lock:
            if self.moves.client is None:
                return
            try:
                moving = self.motion is not None and not self.moves.client.call("motion", motion=self.motion)["done"]
            except DimosError:
                moving = False
            if moving:
                self.moves.used = time.monotonic()
            elif time.monotonic() - self.moves.used > LEASE_KEPT:
                self.moves.close()


class TrajectoryTask:
    """All trajectory tasks of the run: to Python dimos they are one."""

    COMMANDS: ClassVar[list[str]] = ["cancel", "execute", "get_state", "get_status"]

    def __init__(self, of: Coordinator) -> None:
        self.__of = of

    def execute(self, trajectory: Any, current_positions: Any) -> Any:  # the run knows its own positions
        of, number = self.__of, self.__of.ended

        def result(status: Any, message: str = "") -> Any:
            return theirs.TrajectoryExecutionResult(status, message)

        if not isinstance(trajectory, JointTrajectory):
            raise TypeError(f"a {type(trajectory).__name__} is no JointTrajectory")
        if (wrong := mistake(trajectory, of.names)) is not None:
            return result(EXECUTION.INVALID_TRAJECTORY, wrong)
        if not of.command:
            return result(EXECUTION.INVALID_TRAJECTORY, NOT_ALLOWED)
        with of.moves.lock:
            if of.ended != number:
                return result(EXECUTION.INVALID_TRAJECTORY, "it was cancelled before it began")
            try:
                begun = of.moves.call("execute", trajectory=request(trajectory, of.names))
            except Refused as refused:
                known = getattr(EXECUTION, refused.code, EXECUTION.INVALID_TRAJECTORY)
                return result(known, str(refused))
            of.motion = begun["motion"]
            if of.ended != number:
                of.moves.call("cancel", task=begun["task"])
                return result(EXECUTION.INVALID_TRAJECTORY, "it was cancelled as it began")
            return result(EXECUTION.ACCEPTED)

    def cancel(self) -> Any:
        """Cancels the motions of all trajectory tasks, of whichever client."""
        of = self.__of
        of.ended += 1
        if not of.names.trajectory_tasks:
            return theirs.TrajectoryCancellationResult(
                CANCELLATION.NO_TRAJECTORY_TASK, "the run has no trajectory task"
            )
        try:
            ended = [
                result
                for task in of.names.trajectory_tasks
                for result in of.ends.call("cancel", task=task)["tasks"].values()
            ]
        except DimosError as error:
            return theirs.TrajectoryCancellationResult(CANCELLATION.UNCERTAIN, str(error))
        stopped = CANCELLATION.CANCELLED if "CANCELLED" in ended else CANCELLATION.ALREADY_STOPPED
        return theirs.TrajectoryCancellationResult(stopped, "")

    def __report(self) -> Optional[dict[str, Any]]:
        of = self.__of
        if of.motion is None:
            return None
        try:
            return of.reads.call("motion", motion=of.motion)
        except Refused as refused:
            if refused.code == "UNKNOWN_MOTION":  # the run has forgotten it
                return None
            raise

    def get_state(self) -> Any:
        return state_of(self.__report())

    def get_status(self, t_now: Optional[float]) -> Any:
        report = self.__report()
        state = state_of(report)
        now, moving = report or {}, state is TrajectoryState.EXECUTING
        done = state is TrajectoryState.COMPLETED
        return TrajectoryStatus(
            timestamp=time.time(),
            state=state,
            progress=1.0 if done else now.get("progress", 0.0),
            time_elapsed=now.get("elapsed", 0.0),
            time_remaining=now.get("remaining", 0.0) if moving else 0.0,
            error="" if moving else now.get("error") or "",
        )


def state_of(report: Optional[dict[str, Any]]) -> Any:
    """The state of a motion, which ends when the arm is at rest, and is completed only at its goal."""
    if report is None:
        return TrajectoryState.IDLE
    if not report["done"]:
        return TrajectoryState.EXECUTING
    if report["state"] == "COMPLETED" and not report.get("error"):
        return TrajectoryState.COMPLETED
    return TrajectoryState.FAULT if report["state"] == "FAULT" else TrajectoryState.ABORTED


def mistake(trajectory: Any, names: Names) -> Optional[str]:
    """What is wrong with a trajectory, apart from what the run checks."""
    joints = list(trajectory.joint_names)
    if not 0 < len(joints) <= len(names.ours):
        return f"the trajectory names {len(joints)} joints; the coordinator has {len(names.ours)}"
    if unknown := [joint for joint in joints if joint not in names.ours]:
        return f"no joint is named `{str(unknown[0])[:80]}`; the joints are {', '.join(list(names.ours)[:16])}"
    if len(trajectory.points) > MAX_POINTS:
        return f"the trajectory has {len(trajectory.points)} points (limit {MAX_POINTS})"
    return None


def request(trajectory: Any, names: Names) -> dict[str, Any]:
    """A trajectory as the run takes it. Python dimos fills in zeros where no velocities were given, and ignores them:
    taken at their word the arm would rest at each point."""
    moves = any(any(point.velocities) for point in trajectory.points)
    points = []
    for point in trajectory.points:
        made: dict[str, Any] = {
            "time_from_start": float(point.time_from_start),
            "positions": [round(float(q), 9) for q in point.positions],
        }
        if moves and point.velocities:
            made["velocities"] = [round(float(v), 9) for v in point.velocities]
        points.append(made)
    return {"joint_names": [names.ours[joint] for joint in trajectory.joint_names], "points": points}


class GripperTask:
    """A gripper, in its own unit or from 0, closed, to 1, open."""

    COMMANDS: ClassVar[list[str]] = ["get_normalized", "get_position", "set_normalized", "set_position"]

    def __init__(self, of: Coordinator, name: str) -> None:
        self.__of, self.__arm, self.__range = of, name[: -len(GRIPPER)], of.names.grippers[name]

    def get_position(self) -> Optional[list[float]]:
        arms = self.__of.reads.call("state")["arms"]
        position = next(arm["gripper"] for arm in arms if arm["hardware_id"] == self.__arm)
        return None if position is None else [position]

    def get_normalized(self) -> Optional[list[float]]:
        position = self.get_position()
        if position is None or self.__range is None or self.__range[0] == self.__range[1]:
            return None
        closed, opened = self.__range
        return [(position[0] - closed) / (opened - closed)]

    def set_position(self, values: Sequence[float], t_now: Optional[float] = None) -> bool:
        of, number = self.__of, self.__of.ended
        if not of.command:
            raise PermissionError(NOT_ALLOWED)
        if len(values) != 1 or (self.__range and not min(self.__range) <= values[0] <= max(self.__range)):
            return False
        with of.moves.lock:
            if of.ended == number:
                of.moves.call("gripper", arm=self.__arm, position=float(values[0]))
            return of.ended == number

    def set_normalized(self, values: Sequence[float], t_now: Optional[float] = None) -> bool:
        if self.__range is None or len(values) != 1 or not 0 <= values[0] <= 1:
            return False if self.__of.command else self.set_position([])
        closed, opened = self.__range
        return self.set_position([closed + values[0] * (opened - closed)], t_now)
