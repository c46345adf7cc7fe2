"""The client: moves arms, grips, stops."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Optional, Union

from .errors import ArmNotReady, MotionFailed, PlanningFailed, Refused, refusal
from .planning import Goals, Planning, plan_number, where_to
from .records import ArmState, Goal, Grip, Plan, Pose, Waypoint, numbers

GRASP_REACH = 0.2  # m, how far what a gripper has just closed on may be from the tool centre point
STALLED = 15.0  # s without progress, after which `wait` cancels a motion


class Client(Planning):
    """A connection to a run."""

    def state(self, arm: str) -> ArmState:
        """The latest state of an arm."""
        reply = self.call("state")
        if (found := next((a for a in reply["arms"] if a["hardware_id"] == arm), None)) is None:
            raise Refused("UNKNOWN_ARM", f"no arm named {arm}", "`dimos status` lists the arms")
        name, position, velocity, effort = (
            [joint[key] for joint in found["joints"]] for key in ("name", "position", "velocity", "effort")
        )
        pose, age = found["pose"] or {}, found["age_ms"]
        return ArmState(
            reply["tick"],
            reply["stamp"],
            name,
            position,
            velocity,
            effort,
            0,
            age and age / 1000,
            found["gripper"],
            pose.get("xyz"),
            pose.get("rpy"),
            found["wrench"],
            found.get("gripper_unit"),
            found.get("gripper_force"),
            found.get("gripper_force_unit"),
            pose.get("link"),
            pose.get("frame"),
        )

    def move(
        self,
        arm: Goals,
        target: Optional[Sequence[float]] = None,
        speed: float = 0.5,
        wait: bool = True,
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
        direct: bool = False,
        replan: bool = False,
        on_path: Sequence[Mapping[str, Any]] = (),
        until: Optional[Mapping[str, Any]] = None,
        touch: Sequence[str] = (),
        seed: int = 0,
        timeout: Optional[float] = None,
    ) -> dict[str, Any]:
        """Moves an arm to `target` [rad], a `named` pose, a `pose`, `by` a pose or `through` waypoints, or several arms
        together, with all keywords of `plan`; `speed`: 0.01–1 of the limits. With a planner in the run the motion is
        planned around obstacles, and after `replan` planned again when the world changes; `direct` moves straight in
        joint space, not collision-checked. Without a planner it is direct: `collision_checked` in the result says
        which. `on_path`: what is done at places of the path, as {"distance": 0.3, "gripper": {"arm": "arm",
        "to": "open"}}, {"waypoint": 1, "output": {...}} or {..., "speed": 0.5}. `until`: what ends the motion before
        its goal, as {"force": 5}, {"input": "di0"} or {"time": 2}; the result then has `ended_by` and `value`, and
        `Refused` (NOT_MET) is raised if the goal came first. `touch`: obstacles that the end effector may touch.
        Ends this client's own streams to the arm."""
        goal = Goal(target, named, pose, linear, frame, by, via)
        where = where_to(arm, goal, through, blend, tcp_speed)
        plain = isinstance(arm, str) and target is not None and goal == Goal(target) and tcp_speed is None
        joints = numbers(target) if plain and target is not None else []
        if direct and not joints:
            raise Refused("INVALID_PARAMS", "a direct motion goes to joint positions", "give `target`")
        if not direct:
            try:
                self._end_streams(self._streams_to([arm] if isinstance(arm, str) else arm))
                plan = {**where, "speed": speed, "seed": seed, **({"touch": list(touch)} if touch else {})}
                step = {"plan": plan if timeout is None else {**plan, "timeout": timeout}}
                return self._go(step, wait, replan, on_path, until)
            except Refused as error:
                if not (error.code == "NO_PLANNER" and error.data is None and joints):
                    raise  # also when a planner was there and has gone
        move = {"arm": arm, "target": joints, "speed": speed, "direct": direct}
        return self._go({"move": move}, wait, until=until)

    def _go(
        self,
        step: dict[str, Any],
        wait: bool,
        replan: bool = False,
        on_path: Sequence[Mapping[str, Any]] = (),
        until: Optional[Mapping[str, Any]] = None,
    ) -> dict[str, Any]:
        """Lets the run carry out a motion as a whole. What it says of the motion: its end, or without `wait` its
        beginning."""
        conditions = None if until is None else [until]
        number: int = self.call(
            "go", steps=[step], replan=replan or None, on_path=list(on_path) or None, until=conditions
        )["going"]
        try:
            while True:
                report = self.call("going", going=number)
                done = report["steps"][0] if report["steps"] else {}
                if (begun := done.get("begun")) or report["done"]:
                    break
                time.sleep(0.01)
        except BaseException:  # Ctrl-C, too
            self._urgent("cancel", going=number)
            raise
        if begun and wait and until is not None:
            self.wait(begun["motion"])
            while not (report := self.call("going", going=number))["done"]:
                time.sleep(0.01)
            if error := report.get("error"):
                raise refusal(error)
            return dict(report["outcome"])
        if begun:
            return self.wait(begun["motion"]) if wait else dict(begun)
        if (plan := done.get("planning")) and plan["state"] != "PLANNED":
            raise PlanningFailed(plan["state"], plan.get("error") or "there is no plan", plan.get("hint"), plan)
        raise refusal(report["error"])

    def _streams_to(self, arms: Collection[str]) -> set[str]:
        """The tasks to which this client streams, and whose joints a planned motion needs."""
        if not (self._streams or self._targets):
            return set()
        robots = self.call("planner")["robots"]
        joints = {joint for robot in robots if robot["name"] in arms for joint in robot["joints"]}
        return {task["name"] for task in self.status()["tasks"] if joints & set(task["joints"])}

    def execute(
        self,
        motion: Union[Plan, int, Mapping[str, Any], None] = None,
        task: Optional[str] = None,
        wait: bool = True,
        *,
        replan: bool = False,
        unproven: bool = False,
    ) -> dict[str, Any]:
        """Executes a plan (by default the newest of `plan`), or follows a trajectory: joint_names, and points of
        time_from_start [s], positions [rad], velocities [rad/s]. A trajectory is not collision-checked, a plan of the
        level "fast" at samples only: it needs `unproven`."""
        if motion is None or isinstance(motion, (Plan, int)):
            begun = self.call(
                "execute_plan", plan=plan_number(motion), replan=replan or None, unproven=unproven or None
            )
        else:
            begun = self.call("execute", trajectory=dict(motion), task=task)
        return self.wait(begun["motion"]) if wait else begun

    def wait(self, motion: int) -> dict[str, Any]:
        """Waits for a motion's end, and for that of the one that continues it around an obstacle. Ctrl-C cancels it,
        and so do 15 s without progress. Raises MotionFailed when it ended elsewhere than it should."""
        report, elapsed, deadline = self.call("motion", motion=motion), None, 0.0
        try:
            while not report["done"] or report.get("next"):
                if report["elapsed"] != elapsed or report.get("replanning"):
                    elapsed, deadline = report["elapsed"], time.monotonic() + STALLED
                elif time.monotonic() > deadline:
                    raise MotionFailed(report["state"], f"no progress within {STALLED:g} s: cancelled", data=report)
                if report["done"]:
                    motion = report["next"]
                else:
                    time.sleep(0.02)
                report = self.call("motion", motion=motion)
        except (KeyboardInterrupt, MotionFailed):
            self.cancel(task=report["task"])
            raise
        if report["state"] != "COMPLETED":
            raise MotionFailed(report["state"], report["error"] or "it ended before its goal", data=report)
        return report

    def gripper(
        self,
        arm: str,
        opening: Union[float, str],
        force: Optional[float] = None,
        wait: bool = True,
        *,
        speed: Optional[float] = None,
        timeout: Optional[float] = None,
        attach: Optional[str] = None,
    ) -> Grip:
        """Moves a gripper to a position (an opening [m], or the angle [rad] of a rotary one), to "open" or "close",
        with a largest `force` (unit and range are in `status`) and a `speed` (0.01-1 of its top speed) if it has them.
        Waits until the fingers rest, at most `timeout` [s] (20), and returns where and why: `outcome`, as the run
        judges it. If it holds something, `attach`, which is at the fingers, is attached to the arm in the planner."""
        if attach is not None:
            known = [entry["name"] for entry in self.world_list()]
            if attach not in known:
                raise Refused(
                    "UNKNOWN_OBJECT",
                    f"the planner's world has no object {attach}: nothing has moved",
                    f"it has: {', '.join(known) or 'none'}",
                )
        span: Optional[list[float]] = self._report(arm).get("gripper_range")
        if isinstance(opening, str):
            if opening not in ("open", "close"):
                raise Refused(
                    "INVALID_PARAMS", f"{opening!r} is no position of a gripper", 'give "open", "close" or a number'
                )
            if span is None:
                raise Refused("UNSUPPORTED", f"{arm} does not say how far it opens", "give a number")
            opening = span[opening == "open"]
        order = self.call("gripper", arm=arm, position=opening, force=force, speed=speed, timeout=timeout)["order"]
        report = self.call("grip", arm=arm, order=order)
        while wait and not report["done"]:
            time.sleep(0.02)
            report = self.call("grip", arm=arm, order=order)
        if error := report.get("error"):
            if self._report(arm).get("phase") == "held":  # a stop holds the fingers, too
                raise ArmNotReady("ARM_LATCHED", f"{arm}: {error}", "`reset`, then `enable`")
            raise MotionFailed("NO_ANSWER", f"the gripper of {arm}: {error}", data=report)
        grip = Grip(
            report["position"],
            report["unit"],
            report["outcome"] or "moving",
            report.get("force"),
            report["force_unit"],
            report["elapsed"],
        )
        if attach is not None and grip.holding:
            self.attach(attach, arm, within=GRASP_REACH)
        return grip

    def _report(self, arm: str) -> dict[str, Any]:
        arms: list[dict[str, Any]] = self.status()["arms"]
        return next((report for report in arms if report["hardware_id"] == arm), {})

    def io(self, arm: str) -> dict[str, Any]:
        """Digital and analogue inputs and outputs of an arm, as docs/rpc.md says."""
        return self.call("arm_io", arm=arm)

    def set_io(self, arm: str, **outputs: float) -> dict[str, Any]:
        """Sets outputs, `do3=1` or `ao0=2.5`; the levels that are read back."""
        return self.call("arm_io_set", arm=arm, outputs=outputs)

    def payload(self, arm: str) -> Optional[dict[str, Any]]:
        """The load at the flange that the controller reports: mass [kg], center [m], inertia [kg·m²]."""
        load: Optional[dict[str, Any]] = self.call("arm_payload", arm=arm)["payload"]
        return load

    def set_payload(self, arm: str, mass: float, center: Sequence[float] = (0, 0, 0)) -> Optional[dict[str, Any]]:
        """Sets the load of everything at the flange [kg, m], at rest; what the controller then reports."""
        reply = self.call("arm_payload_set", arm=arm, mass=mass, center=numbers(center))
        load: Optional[dict[str, Any]] = reply["payload"]
        return load

    def cancel(self, arm: Optional[str] = None, task: Optional[str] = None) -> dict[str, str]:
        """Ends motions by decelerating: of an arm, of a task, or all; without a task also planning."""
        ended: dict[str, str] = self._urgent("cancel", arm=arm, task=task)["tasks"]
        return ended

    def speed(self, fraction: Optional[float] = None, paused: Optional[bool] = None) -> dict[str, Any]:
        """Sets the speed override of the run (0.01–1), pauses or resumes all motions; `fraction` and `paused` now."""
        return self.call("speed", fraction=fraction, paused=paused)

    def save_pose(self, name: str, *arms: str) -> dict[str, Any]:
        """Saves where arms are, by default all, as a named pose. What was saved [rad], by arm and joint."""
        saved: dict[str, Any] = self.call("pose_save", name=name, arms=list(arms))["pose"]
        return saved

    def stop(self, arm: Optional[str] = None) -> dict[str, str]:
        """Latched hold at once, of an arm or of all: an operational stop. Per arm `confirmed`, or not."""
        stopped: dict[str, str] = self._urgent("stop", arm=arm)["arms"]
        return stopped

    def reset(self, arm: str) -> str:
        """Clears a latched hold or a fault. Moves nothing, enables nothing. The arm's phase."""
        return str(self.call("arm_reset", arm=arm)["phase"])

    def enable(self, arm: str) -> str:
        """Enables the motors and makes the arm ready, where it is. The arm's phase."""
        return str(self.call("arm_enable", arm=arm)["phase"])

    def teach(self, arm: str, support_the_arm: bool = False) -> str:
        """Lets the arm be led by hand until `enable`. How it is led."""
        return str(self.call("arm_teach", arm=arm, support_the_arm=support_the_arm)["note"])
