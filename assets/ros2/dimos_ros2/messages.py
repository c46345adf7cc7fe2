"""Messages of ROS 2 from the replies of a run. They are made by a function that is passed in, so this needs no ROS."""

from __future__ import annotations

from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence

from dimos_client import JointState

Make = Callable[..., Any]  # from the name of a type, such as "std_msgs/msg/String", and its fields
OK, WARN, ERROR = 0, 1, 2  # levels of diagnostic_msgs/DiagnosticStatus
NAN = float("nan")


class Messages:
    """Makes messages."""
    def __init__(self, make: Make) -> None:
        self.make = make

    def time(self, seconds: float, of: str = "builtin_interfaces/msg/Time") -> Any:
        """A time [s since 1970], or a duration."""
        total = round(seconds * 1e9)
        return self.make(of, sec=total // 10**9, nanosec=total % 10**9)

    def duration(self, seconds: float) -> Any:
        """A duration [s]."""
        return self.time(seconds, "builtin_interfaces/msg/Duration")

    def header(self, stamp: float, frame: str) -> Any:
        """A header; `stamp` in s since 1970."""
        return self.make("std_msgs/msg/Header", stamp=self.time(stamp), frame_id=frame)

    def joint_state(self, state: JointState) -> Any:
        """From the joints after a tick. Unknown values are NaN; a list without any known one is empty."""
        return self.make("sensor_msgs/msg/JointState", header=self.header(state.stamp, ""), name=list(state.name),
                         position=known(state.position), velocity=known(state.velocity), effort=known(state.effort))

    def transforms(self, transforms: Sequence[Mapping[str, Any]], stamp: float) -> Any:
        """From the transforms of `transforms`, or the fixed ones of `robot_description`."""
        return self.make("tf2_msgs/msg/TFMessage", transforms=[self._transform(t, stamp) for t in transforms])

    def _transform(self, transform: Mapping[str, Any], stamp: float) -> Any:
        vector = self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", transform["xyz"])))
        turn = self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", transform["quat"])))
        return self.make("geometry_msgs/msg/TransformStamped", header=self.header(stamp, transform["parent"]),
                         child_frame_id=transform["child"],
                         transform=self.make("geometry_msgs/msg/Transform", translation=vector, rotation=turn))

    def diagnostics(self, status: Mapping[str, Any], stamp: float) -> Any:
        """From the reply to `status`: one status per arm, and one of the tick."""
        rows = [self._arm(status["run"], arm) for arm in status["arms"]] + [self._tick(status["run"], status["ticks"])]
        return self.make("diagnostic_msgs/msg/DiagnosticArray", header=self.header(stamp, ""), status=rows)

    def _arm(self, run: str, arm: Mapping[str, Any]) -> Any:
        phase, link = arm["phase"], arm["link"]
        lost = link in ("faulted", "down") or arm["error"] or phase == "unknown"
        level = ERROR if lost or phase == "held" else OK if phase == "ready" and link == "up" else WARN
        text = ", ".join(str(part) for part in (phase, arm["cause"], arm["error"]) if part)
        values = {"link": link, "mode": arm["mode"], "simulated": arm["simulated"], "age [ms]": arm["state_age_ms"],
                  "rate [Hz]": arm["measured_rate_hz"], "faults": "; ".join(map(str, arm["faults"]))}
        return self._status(f"{run}: {arm['hardware_id']}", level, text, arm["address"], values)

    def _tick(self, run: str, ticks: Mapping[str, Any]) -> Any:
        late, compute = ticks["lateness_us"], ticks["compute_us"]
        level = WARN if ticks["overruns"] or ticks["skipped"] else OK
        values = {"ticks": ticks["count"], "overruns": ticks["overruns"], "skipped": ticks["skipped"],
                  "lateness p99 [us]": late["p99"], "lateness max [us]": late["max"], "compute p99 [us]": compute["p99"]}
        return self._status(f"{run}: tick", level, f"late by {late['p99']} us (p99)", "", values)

    def _status(self, name: str, level: int, text: str, hardware: str, values: Mapping[str, Any]) -> Any:
        pairs = [self.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in values.items()
                 if value is not None]
        return self.make("diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=text,
                         hardware_id=hardware or "", values=pairs)

    def feedback(self, joints: List[str], desired: Mapping[str, List[float]],
                 actual: Mapping[str, List[float]]) -> Dict[str, Any]:
        """The fields of a feedback of FollowJointTrajectory: positions [rad] and velocities [rad/s], and their error."""
        error = {key: [a - b for a, b in zip(desired[key], actual[key])] for key in desired}
        return {"joint_names": joints, "desired": self._point(desired), "actual": self._point(actual),
                "error": self._point(error)}

    def _point(self, values: Mapping[str, List[float]]) -> Any:
        return self.make("trajectory_msgs/msg/JointTrajectoryPoint", time_from_start=self.duration(0.0),
                         accelerations=[], effort=[], **values)


def known(values: Sequence[Optional[float]]) -> List[float]:
    """Numbers; NaN for what is unknown, and nothing if all is."""
    return [] if all(v is None for v in values) else [NAN if v is None else float(v) for v in values]
