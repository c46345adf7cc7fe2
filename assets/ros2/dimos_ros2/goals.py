"""Goals of FollowJointTrajectory: read, executed by a run, watched until they end. Needs no ROS."""

from __future__ import annotations

import time
from bisect import bisect_right
from dataclasses import dataclass, field
from typing import Any, Callable, Dict, List, Mapping, Optional

from dimos_client import Client, DimosError, Refused

from .messages import NAN

SUCCESSFUL, INVALID_GOAL, INVALID_JOINTS, OLD_HEADER_TIMESTAMP, PATH_TOLERANCE, GOAL_TOLERANCE = range(0, -6, -1)
PERIOD = 0.05  # s between two reports of a motion: feedback comes 20 times a second
AT_START = 1e-6  # s, below which a point is one of the start
Values = Dict[str, List[float]]  # "positions" [rad] and "velocities" [rad/s], in the order of the joints


@dataclass
class Result:
    """How a goal ended."""
    code: int
    text: str = ""
    cancelled: bool = False


@dataclass
class Goal:
    """A trajectory and how exactly it must be followed."""
    joints: List[str]
    points: List[Dict[str, Any]]
    stamp: float = 0.0  # s since 1970, of the start; 0: now
    path: Dict[str, Mapping[str, float]] = field(default_factory=dict)  # tolerances by joint, then by what
    end: Dict[str, Mapping[str, float]] = field(default_factory=dict)
    late: float = 0.0  # s that the joints may take to arrive after the end of the trajectory

    @classmethod
    def read(cls, goal: Any) -> Goal:
        """From `FollowJointTrajectory.Goal`."""
        points = [{"time_from_start": seconds(point.time_from_start),
                   **{key: [float(x) for x in getattr(point, key)] for key in ("positions", "velocities", "accelerations")
                      if len(getattr(point, key))}} for point in goal.trajectory.points]
        return cls(list(goal.trajectory.joint_names), points, seconds(goal.trajectory.header.stamp),
                   tolerances(goal.path_tolerance), tolerances(goal.goal_tolerance), seconds(goal.goal_time_tolerance))

    def duration(self) -> float:
        """Time of the last point [s]."""
        return float(self.points[-1]["time_from_start"]) if self.points else 0.0

    def desired(self, at: float) -> Values:
        """The trajectory at a time [s]: cubic where the points have velocities, else straight."""
        times = [point["time_from_start"] for point in self.points]
        after = min(max(bisect_right(times, at), 1), len(times) - 1)
        a, b = self.points[after - 1], self.points[after]
        span = max(times[after] - times[after - 1], 1e-9)
        s = min(max((at - times[after - 1]) / span, 0.0), 1.0)
        out: Values = {"positions": [], "velocities": []}
        for k, (p, q) in enumerate(zip(a["positions"], b["positions"])):
            straight = (q - p) / span
            v, w = (point.get("velocities", [straight] * (k + 1))[k] for point in (a, b))
            c, d = 3 * straight - 2 * v - w, v + w - 2 * straight  # of p + span·(v·s + c·s² + d·s³)
            out["positions"].append(p + span * s * (v + s * (c + s * d)))
            out["velocities"].append(v + s * (2 * c + 3 * s * d))
        return out


def seconds(time_of: Any) -> float:
    """A time or duration of ROS [s]."""
    return float(time_of.sec) + float(time_of.nanosec) * 1e-9


def tolerances(given: Any) -> Dict[str, Mapping[str, float]]:
    """Tolerances by joint; 0 means the task's own, and less than 0 none: the run applies its own in any case."""
    keys = {"positions": "position", "velocities": "velocity"}
    return {t.name: {key: limit for key, own in keys.items() if (limit := float(getattr(t, own))) > 0} for t in given}


def follow(client: Client, task: str, goal: Goal, feedback: Callable[[Values, Values], None],
           cancelled: Callable[[], bool], now: float) -> Result:
    """Executes a goal by a trajectory task, and returns how it ended; `now` in s since 1970. The arm is at rest then."""
    if not goal.points or any(len(point.get("positions", ())) != len(goal.joints) for point in goal.points):
        return Result(INVALID_GOAL, "every point needs one position per joint")
    own: List[str] = next((t["joints"] for t in client.status()["tasks"] if t["name"] == task), [])
    if sorted(own) != sorted(goal.joints):
        return Result(INVALID_JOINTS, f"{task} has the joints {', '.join(own)}")
    if goal.stamp and goal.stamp + goal.duration() < now:
        return Result(OLD_HEADER_TIMESTAMP, f"the trajectory ended {now - goal.stamp - goal.duration():.3f} s ago")
    if goal.stamp > now + PERIOD:
        return Result(INVALID_GOAL, f"it would start in {goal.stamp - now:.3f} s: send it when it starts")
    if goal.points[0]["time_from_start"] > AT_START:
        goal.points.insert(0, start(measured(client, goal.joints), goal.points[0]))
    try:
        motion = client.execute({"joint_names": goal.joints, "points": goal.points}, task, wait=False)["motion"]
    except Refused as error:
        return Result(INVALID_JOINTS if error.code == "UNKNOWN_JOINT" else INVALID_GOAL, str(error))
    return watch(client, task, goal, motion, feedback, cancelled)


def start(at: Values, first: Mapping[str, Any]) -> Dict[str, Any]:
    """The point at which a trajectory begins whose first point is later: where the arm is, at rest. It has what the
    first one has, so that the motion between them is as smooth."""
    rest = {key: [0.0] * len(first[key]) for key in ("velocities", "accelerations") if key in first}
    return {"time_from_start": 0.0, "positions": at["positions"], **rest}


def watch(client: Client, task: str, goal: Goal, motion: int, feedback: Callable[[Values, Values], None],
          cancelled: Callable[[], bool]) -> Result:
    """Follows a motion to its end."""
    ended: Optional[Result] = None
    try:
        while not (report := client.call("motion", motion=motion))["done"]:
            actual, desired = measured(client, goal.joints), goal.desired(report["progress"] * goal.duration())
            feedback(desired, actual)
            if ended is None and cancelled():
                ended = Result(SUCCESSFUL, "cancelled", cancelled=True)
                client.cancel(task=task)
            elif ended is None and (text := outside(goal.joints, goal.path, desired, actual)):
                ended = Result(PATH_TOLERANCE, text)
                client.cancel(task=task)
            time.sleep(PERIOD)
    except BaseException:
        client.cancel(task=task)
        raise
    if ended:
        return ended
    if report["state"] != "COMPLETED":
        arrived = report["progress"] >= 1.0
        return Result(GOAL_TOLERANCE if arrived else PATH_TOLERANCE, report["error"] or report["state"])
    return arrival(client, goal)


def arrival(client: Client, goal: Goal) -> Result:
    """Waits until all joints are within the goal's own tolerances."""
    deadline, target = time.monotonic() + goal.late, goal.desired(goal.duration())
    while text := outside(goal.joints, goal.end, target, measured(client, goal.joints)):
        if time.monotonic() > deadline:
            return Result(GOAL_TOLERANCE, text)
        time.sleep(PERIOD)
    return Result(SUCCESSFUL)


def measured(client: Client, joints: List[str]) -> Values:
    """Measured positions and velocities of joints; NaN for what is unknown."""
    known = {joint["name"]: joint for arm in client.call("state")["arms"] for joint in arm["joints"]}
    if missing := [joint for joint in joints if joint not in known]:
        raise DimosError("UNKNOWN_JOINT", f"the run has no joint {missing[0]}")
    return {key: [NAN if (value := known[joint][own]) is None else value for joint in joints]
            for key, own in (("positions", "position"), ("velocities", "velocity"))}


def outside(joints: List[str], limits: Mapping[str, Mapping[str, float]], desired: Values, actual: Values) -> str:
    """Which joint is outside its tolerance, and by how much; nothing if none is. What is unknown is outside."""
    units = {"positions": "rad", "velocities": "rad/s"}
    for k, joint in enumerate(joints):
        for key, limit in limits.get(joint, {}).items():
            if not abs(error := desired[key][k] - actual[key][k]) <= limit:
                return f"{joint} was {abs(error):.4f} {units[key]} away (tolerance {limit:g})"
    return ""
