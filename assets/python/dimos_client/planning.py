"""Plans around obstacles, and the world that they avoid."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from typing import Any, Optional, Union

from .errors import PlanningFailed, Refused
from .records import Goal, Plan, Pose, Waypoint, numbers
from .streams import Streams

Goals = Union[str, Mapping[str, Goal]]  # an arm, whose goal follows, or the goals of several


class Planning(Streams):
    """A connection that plans. All of this needs a planner in the run, else Refused with the code NO_PLANNER."""

    def plan(
        self,
        arm: Goals,
        target: Optional[Sequence[float]] = None,
        *,
        named: Optional[str] = None,
        pose: Optional[Pose] = None,
        by: Optional[Pose] = None,
        frame: Optional[str] = None,
        linear: bool = False,
        via: Optional[Sequence[float]] = None,
        tcp_speed: Optional[float] = None,
        through: Sequence[Waypoint] = (),
        blend: float = 0.0,
        speed: float = 0.5,
        seed: int = 0,
        timeout: Optional[float] = None,
        level: str = "certified",
        refine: int = 4,
    ) -> Plan:
        """Plans a collision-free motion from where the arm is, and waits for the plan; moves nothing. The goal is one
        of `target` (joints [rad]), a `named` pose, a `pose` of the tool centre point, or a motion `by` a pose from
        where that is; both in `frame`, on a straight line if `linear`, on an arc through the place `via`. Or one motion
        `through` waypoints, of which the last is the goal; it passes them within `blend` [m], or stops at each. No tool
        is faster than `tcp_speed` [m/s].
        Several arms move together: `plan({"left": Goal(named="home"), "right": Goal(named="home")})`.
        `level`: "certified" proves the plan free of contact, "exact" also finds its clearance to 0.5 mm, "fast" checks
        samples only: `execute` takes such a plan with `unproven`. `refine`: rounds that look for a shorter path."""
        where = where_to(arm, Goal(target, named, pose, linear, frame, by, via), through, blend, tcp_speed)
        return self._planned(where, speed=speed, seed=seed, timeout=timeout, level=level, refine=refine)

    def _planned(self, where: dict[str, Any], **settings: Any) -> Plan:
        """Plans, and waits for the plan."""
        number: int = self.call("plan", **where, **settings)["plan"]
        try:
            while (report := self.call("planning", plan=number))["state"] == "PLANNING":
                time.sleep(0.01)
        except BaseException:  # Ctrl-C, too
            self.cancel_plan(number)
            raise
        if report["state"] != "PLANNED":
            raise PlanningFailed(report["state"], report.get("error") or "there is no plan", report.get("hint"), report)
        return Plan(number, report["elapsed"], report["summary"])

    def cancel_plan(self, plan: Union[Plan, int]) -> bool:
        """Ends the planning of a plan, and no motion. Whether it was being planned."""
        return bool(self.call("cancel", plan=plan_number(plan)).get("planning", False))

    def preview(self, plan: Union[Plan, int, None] = None, hz: Optional[float] = None) -> dict[str, Any]:
        """A plan, by default the newest of `plan`, in full: `trajectory`, and per arm the path of its end effector [m]
        in `end_effectors`. With `hz` sampled at that rate, with `orientations`."""
        return self.call("preview", plan=plan_number(plan), hz=hz)

    def named_poses(self, arm: str) -> dict[str, list[float]]:
        """The named poses of an arm [rad], saved ones too."""
        robots = {robot["name"]: robot for robot in self.call("planner")["robots"]}
        if arm not in robots:
            raise Refused("UNKNOWN_ROBOT", f"the planner has no robot named {arm}", f"it has {', '.join(robots)}")
        joints: list[str] = robots[arm]["joints"]
        poses: dict[str, list[float]] = dict(robots[arm]["named_poses"])
        for name, arms in self.call("poses")["poses"].items():
            at = {joint: position for of_arm in arms.values() for joint, position in of_arm.items()}
            if all(joint in at for joint in joints):
                poses.setdefault(name, [at[joint] for joint in joints])
        return poses

    def world_add(
        self,
        name: str,
        *,
        box: Optional[Sequence[float]] = None,
        sphere: Optional[float] = None,
        cylinder: Optional[Sequence[float]] = None,
        mesh: Optional[str] = None,
        cloud: Optional[str] = None,
        xyz: Sequence[float] = (0, 0, 0),
        rpy: Optional[Sequence[float]] = None,
        quat: Optional[Sequence[float]] = None,
        padding: float = 0.0,
    ) -> None:
        """Adds an obstacle, or replaces the one of its name: a `box` (edges x, y, z), `sphere` (radius), `cylinder`
        (radius, length along z), `mesh` or `cloud` (a file), with its centre at `xyz` in `map` [m]."""
        shapes = {
            "box": None if box is None else numbers(box),
            "sphere": sphere,
            "cylinder": None if cylinder is None else numbers(cylinder),
            "mesh": mesh and os.path.abspath(mesh),
            "cloud": cloud and os.path.abspath(cloud),
        }
        given = {key: value for key, value in shapes.items() if value is not None}
        if len(given) != 1:
            hint = "give one of box, sphere, cylinder, mesh, cloud"
            raise Refused("INVALID_PARAMS", f"{name} has {len(given)} shapes", hint)
        self.call("world_add", name=name, shape=given, pose=Pose(xyz, rpy, quat).params(), padding=padding)

    def world_move(
        self,
        name: str,
        xyz: Sequence[float],
        rpy: Optional[Sequence[float]] = None,
        quat: Optional[Sequence[float]] = None,
    ) -> None:
        """Moves an obstacle."""
        self.call("world_move", name=name, pose=Pose(xyz, rpy, quat).params())

    def world_remove(self, name: Optional[str] = None) -> None:
        """Removes an object or, without a name, all that no arm holds."""
        self.call("world_remove", name=name)

    def world_list(self) -> list[dict[str, Any]]:
        """The objects: name, shape, pose, padding, and `held_by` (arm, link)."""
        objects: list[dict[str, Any]] = self.call("world")["objects"]
        return objects

    def attach(
        self,
        name: str,
        arm: str,
        link: Optional[str] = None,
        touch_links: Sequence[str] = (),
        mass: Optional[float] = None,
        within: Optional[float] = None,
    ) -> dict[str, Any]:
        """Attaches an object, where it is, to a `link` of an arm (default: its end effector), which may touch it and so
        may `touch_links`. With `mass` [kg] the arm's controller is set to carry it: the reply has load and payload. An
        object farther than `within` [m] from the tool centre point is refused."""
        return self.call(
            "attach", name=name, robot=arm, link=link, touch_links=list(touch_links), mass=mass, within=within
        )

    def detach(self, name: str) -> None:
        """Detaches an object; it remains where it is."""
        self.call("detach", name=name)


def plan_number(plan: Union[Plan, int, None]) -> Optional[int]:
    """The number of a plan."""
    return plan.number if isinstance(plan, Plan) else plan


def is_given(goal: Goal) -> bool:
    """Whether anything of a goal is given."""
    given = (goal.joints, goal.named, goal.pose, goal.by, goal.frame, goal.via)
    return goal.linear or any(one is not None for one in given)


def where_to(
    arm: Goals, goal: Goal, through: Sequence[Waypoint], blend: float, tcp_speed: Optional[float]
) -> dict[str, Any]:
    """The parameters of `plan` that say where, and how fast the tool is."""
    most = {} if tcp_speed is None else {"tcp_speed": tcp_speed}
    if not through:
        return {"goals": [goal.params(name) for name, goal in goals_of(arm, goal).items()], **most}
    if not isinstance(arm, str) or is_given(goal):
        raise Refused("INVALID_PARAMS", "waypoints are for one arm, and the last is its goal", "give no other goal")
    way = [waypoint(at).params(arm) for at in through]
    return {"goals": way[-1:], "through": way[:-1], "blend": blend, **most}


def waypoint(at: Waypoint) -> Goal:
    """A waypoint as a goal."""
    if isinstance(at, Goal):
        return at
    if isinstance(at, str):
        return Goal(named=at)
    return Goal(pose=at) if isinstance(at, Pose) else Goal(joints=at)


def goals_of(arm: Goals, goal: Goal) -> dict[str, Goal]:
    """The goals of one arm or of several, by arm."""
    if isinstance(arm, str):
        return {arm: goal}
    if is_given(goal):
        raise Refused("INVALID_PARAMS", "several arms have a goal each", "give none besides them")
    return dict(arm)
