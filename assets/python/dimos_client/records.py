"""What the client takes and returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Optional, Union

from .errors import Refused


def numbers(values: Sequence[float]) -> list[float]:
    """Plain numbers, also of an array of another library."""
    try:
        return [float(value) for value in values]
    except (TypeError, ValueError):
        hint = f"a named pose: named={values!r}" if isinstance(values, str) else None
        raise Refused("INVALID_PARAMS", f"{values!r} is not a list of numbers", hint) from None


@dataclass(frozen=True)
class JointState:
    """Joints after a tick, all lists in the order of `name`."""

    tick: int
    stamp: float  # s since 1970
    name: list[str]
    position: list[Optional[float]]  # rad
    velocity: list[Optional[float]]  # rad/s
    effort: list[Optional[float]]  # Nm
    lost: int = 0  # messages that this reader missed just before, because it was too slow

    def only(self, names: Sequence[str]) -> JointState:
        """The same for these joints, in this order."""
        of = [self.name.index(name) for name in names]
        position, velocity, effort = ([v[k] for k in of] for v in (self.position, self.velocity, self.effort))
        return JointState(self.tick, self.stamp, list(names), position, velocity, effort, self.lost)


@dataclass(frozen=True)
class ArmState(JointState):
    """An arm after a tick."""

    age: Optional[float] = None  # s, of its joints
    gripper: Optional[float] = None  # m of opening, or rad of a rotary jaw
    xyz: Optional[list[float]] = None  # m, of the tool centre point in `frame`; None without a model of the arm
    rpy: Optional[list[float]] = None  # rad, fixed axes
    wrench: Optional[list[float]] = None  # N, N, N, Nm, Nm, Nm
    gripper_unit: Optional[str] = None  # "m" or "rad"
    gripper_force: Optional[float] = None  # measured, in gripper_force_unit
    gripper_force_unit: Optional[str] = None  # "N" or "Nm"
    link: Optional[str] = None  # the link of the model, or that of the tool, whose pose xyz and rpy are
    frame: Optional[str] = None  # "map"


@dataclass(frozen=True)
class Pose:
    """A pose of an arm's tool centre point, or of an object; in the frame `map` unless a goal has another one."""

    xyz: Sequence[float]  # m
    rpy: Optional[Sequence[float]] = None  # rad, fixed axes; without rpy and quat the orientation is free
    quat: Optional[Sequence[float]] = None  # x, y, z, w

    def params(self) -> dict[str, Any]:
        """The pose as a parameter of a request."""
        given = {"xyz": self.xyz, "rpy": self.rpy, "quat": self.quat}
        return {key: numbers(value) for key, value in given.items() if value is not None}


@dataclass(frozen=True)
class Goal:
    """Goal or waypoint of an arm: one of `joints` [rad], `named`, `pose`, `by`."""

    joints: Optional[Sequence[float]] = None
    named: Optional[str] = None
    pose: Optional[Pose] = None
    linear: bool = False  # the tool centre point moves to `pose` on a straight line
    frame: Optional[str] = None  # of `pose` or `by`: "map" (default), "base", "tool", or an object of the world
    by: Optional[Pose] = None  # a motion of the tool centre point from where it is, along the axes of `frame`
    via: Optional[Sequence[float]] = None  # a place [m] on the arc of a circle to `pose` or `by`, along the same axes

    def params(self, arm: str) -> dict[str, Any]:
        """The goal as a parameter of `plan`."""
        goal: dict[str, Any] = {"robot": arm}
        if self.joints is not None:
            goal["joints"] = numbers(self.joints)
        if self.named is not None:
            goal["named"] = self.named
        for key, pose in (("pose", self.pose), ("by", self.by)):
            if pose is None:
                continue
            if not isinstance(pose, Pose):
                hint = "Pose([x, y, z], rpy=[r, p, y]), or without rpy in any orientation"
                raise Refused("INVALID_PARAMS", f"{key} is {pose!r}, must be a Pose", hint)
            goal[key] = pose.params()
        if self.linear:
            goal["linear"] = True
        if self.via is not None:
            goal["via"] = numbers(self.via)
        if self.frame is not None:
            goal["frame"] = self.frame
        return goal


Waypoint = Union[str, Sequence[float], Pose, Goal]  # a named pose, joints [rad], a pose, or a goal with its settings


@dataclass(frozen=True)
class Plan:
    """A motion that was planned, and has not moved anything."""

    number: int
    elapsed: float  # s of planning
    summary: dict[str, Any]  # joints, start, goal, duration, clearance, …: docs/rpc.md

    @property
    def duration(self) -> float:
        """Duration of the motion [s]."""
        return float(self.summary["duration"])

    @property
    def clearance(self) -> Optional[float]:
        """Distance to obstacles and between links that the whole motion is proven to keep [m]; None if nothing is
        proven or nothing can collide."""
        return self.summary.get("clearance")


@dataclass(frozen=True)
class Grip:
    """A gripper after a command."""

    position: float  # in `unit`
    unit: str  # "m", "rad" or "on_off" (0 closed, 1 open)
    # "open", "closed" or "reached"; "holding" (stopped while closing), "blocked" (opening); "ordered" (nothing measures
    # the fingers); "moving"
    outcome: str
    force: Optional[float] = None  # measured, in `force_unit`
    force_unit: Optional[str] = None  # "N", "Nm" or "%"
    elapsed: float = 0.0  # s from the command to the last motion of the fingers

    @property
    def holding(self) -> bool:
        """Whether the gripper holds an object, as the run judges it."""
        return self.outcome == "holding"


@dataclass(frozen=True)
class ChunkReport:
    """What became of a chunk."""

    actions: int
    late: int  # of them, skipped because their time was over; if all are late, nothing has changed


@dataclass(frozen=True)
class LoopReport:
    """How a policy loop kept its time."""

    sent: int  # targets that the run took
    missed: int  # periods that were missed because the policy or the computer took longer than one
    worst: float  # s, the latest start of a period
    seconds: float  # s, how long the loop ran


def joint_state(message: dict[str, Any]) -> JointState:
    """The joint state of a stream's message."""
    data = message["data"]
    return JointState(
        data["tick"],
        data["stamp"],
        data["name"],
        data["position"],
        data["velocity"],
        data["effort"],
        message.get("lost", 0),
    )
