"""Tries assets/ros2 without ROS: its messages with the types of rosbags, its goals with a run of yourarm-planner."""

import dataclasses
import time

import numpy
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dimos_client import Client
from dimos_ros2.goals import GOAL_TOLERANCE, INVALID_GOAL, INVALID_JOINTS, OLD_HEADER_TIMESTAMP, PATH_TOLERANCE, Goal, follow
from dimos_ros2.messages import Messages
from try_support import near

TOLERANCE = "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"
GOAL = """trajectory_msgs/JointTrajectory trajectory
control_msgs/JointTolerance[] path_tolerance
control_msgs/JointTolerance[] goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
"""
FEEDBACK = """string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
"""


def make(name, /, **fields):
    """A message as rosbags wants it: every field, numbers in arrays."""
    kind = store.types[name]
    hints = {f.name: str(f.type) for f in dataclasses.fields(kind) if f.name[0].islower()}
    assert not set(fields) - set(hints), f"{name} has no {set(fields) - set(hints)}"
    return kind(**{key: numpy.array(fields[key], dtype=float) if "ndarray" in hint else fields[key]
                   for key, hint in hints.items()})


def passed(message):
    """The message after CDR: what another node would read."""
    name = message.__msgtype__
    return store.deserialize_cdr(store.serialize_cdr(message, name), name)


def trajectory(points, stamp=0.0, **tolerances):
    """A goal: rows of (time, positions, velocities)."""
    rows = [make("trajectory_msgs/msg/JointTrajectoryPoint", positions=p, velocities=v, accelerations=[], effort=[],
                 time_from_start=messages.duration(t)) for t, p, v in points]
    given = {key: [make("control_msgs/msg/JointTolerance", name=joint, position=p, velocity=0.0, acceleration=0.0)
                   for joint, p in tolerances.get(key, {}).items()] for key in ("path_tolerance", "goal_tolerance")}
    path = make("trajectory_msgs/msg/JointTrajectory", header=messages.header(stamp, ""), joint_names=JOINTS, points=rows)
    return Goal.read(passed(make("control_msgs/msg/FollowJointTrajectoryGoal", trajectory=path, **given,
                                 goal_time_tolerance=messages.duration(tolerances.get("late", 0.0)))))


def try_messages(client):
    state = next(client.joint_states(50))
    read = passed(messages.joint_state(state))
    assert read.name == state.name and near(read.position, state.position, 0), read
    assert abs(read.header.stamp.sec + read.header.stamp.nanosec * 1e-9 - state.stamp) < 1e-6
    unknown = dataclasses.replace(state, position=[None] * 6, velocity=[0.1] + [None] * 5)
    read = passed(messages.joint_state(unknown))
    assert len(read.position) == 0 and read.velocity[0] == 0.1 and numpy.isnan(read.velocity[1])
    described, moved = client.call("robot_description"), client.call("transforms")
    assert "<robot" in described["urdf"]
    fixed, moved = (passed(messages.transforms(t, time.time())) for t in (described["fixed"], moved["transforms"]))
    chain = {t.child_frame_id: t for t in [*fixed.transforms, *moved.transforms]}
    tcp, frame = numpy.eye(4), "arm_tcp"
    while frame != "map":  # from the tool centre point up to `map`
        tcp, frame = matrix(chain[frame].transform) @ tcp, chain[frame].header.frame_id
    assert near(tcp[:3, 3], client.state("arm").xyz, 1e-4), tcp
    rows = passed(messages.diagnostics(client.status(), time.time())).status
    assert [(row.level, row.message) for row in rows][0] == (0, "ready"), rows
    assert rows[1].name.endswith(": tick")


def matrix(transform):
    """A homogeneous transform."""
    q, t, out = transform.rotation, transform.translation, numpy.eye(4)
    x, y, z, w = q.x, q.y, q.z, q.w
    out[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                   [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                   [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    out[:3, 3] = [t.x, t.y, t.z]
    return out


def run(client, goal, cancelled=lambda: False):
    """Executes a goal; its result and its feedback."""
    seen = []

    def feedback(desired, actual):
        message = make("control_msgs/msg/FollowJointTrajectoryFeedback",
                       **messages.feedback(goal.joints, desired, actual))
        seen.append(passed(message))

    return follow(client, "traj_arm", goal, feedback, cancelled, time.time()), seen


def try_goals(client):
    at, still = client.state("arm").position, [0.0] * 6
    there = [at[0] + 0.3, *at[1:]]
    result, seen = run(client, trajectory([(0.0, at, still), (1.5, there, still)]))
    assert (result.code, result.text) == (0, ""), result
    assert near(client.state("arm").position, there) and len(seen) > 10
    middle = seen[len(seen) // 2]
    assert at[0] < middle.desired.positions[0] < there[0] and abs(middle.error.positions[0]) < 0.1, middle
    # A first point that is later than the start: from where the arm is.
    result, _ = run(client, trajectory([(1.5, at, still)]))
    assert result.code == 0 and near(client.state("arm").position, at), result
    assert run(client, trajectory([(0.0, at, still), (2.0, there, still)]))[0].code == 0
    started = time.monotonic()
    result, _ = run(client, trajectory([(4.0, at, still)]), lambda: time.monotonic() - started > 1.0)
    assert result.cancelled and time.monotonic() - started < 3.5, result
    assert client.call("motion", motion=newest(client))["done"], "the arm rests after a cancelled goal"
    assert not near(client.state("arm").position, at), "it was cancelled on its way"
    result, _ = run(client, trajectory([(2.0, at, still)], path_tolerance={"arm_joint1": 1e-7}))
    assert result.code == PATH_TOLERANCE and "arm_joint1 was 0." in result.text, result
    # The arm droops by 0.002 rad: within the task's tolerance, not within the goal's.
    result, _ = run(client, trajectory([(2.0, at, still)], goal_tolerance={"arm_joint2": 1e-4}, late=0.2))
    assert result.code == GOAL_TOLERANCE and "arm_joint2 was 0.00" in result.text, result


def try_refusals(client):
    at, still = client.state("arm").position, [0.0] * 6
    far = [at[0] + 0.5, *at[1:]]
    result, _ = run(client, trajectory([(0.0, far, still), (1.0, at, still)]))
    assert result.code == INVALID_GOAL and "START_STATE_MISMATCH" in result.text, result
    result, _ = run(client, trajectory([(0.05, far, still)]))
    assert result.code == INVALID_GOAL and "OUT_OF_LIMITS" in result.text, result
    result, _ = run(client, trajectory([(1.0, at, still)], stamp=time.time() - 60))
    assert result.code == OLD_HEADER_TIMESTAMP, result
    result, _ = run(client, trajectory([(1.0, at, still)], stamp=time.time() + 60))
    assert result.code == INVALID_GOAL, result
    other = trajectory([(1.0, at, still)])
    other.joints = ["nose", *JOINTS[1:]]
    result, _ = run(client, other)
    assert result.code == INVALID_JOINTS, result
    result, _ = run(client, trajectory([]))
    assert result.code == INVALID_GOAL, result
    client.call("release")
    with Client.connect() as second:
        second.call("lease", arm="arm")
        result, _ = run(client, trajectory([(1.0, at, still)]))
        assert result.code == INVALID_GOAL and "LEASE_HELD" in result.text, result


def newest(client):
    """The number of the newest motion."""
    return next(task["motion"] for task in client.status()["tasks"] if task["name"] == "traj_arm")


store = get_typestore(Stores.ROS2_HUMBLE)
for name, text in (("JointTolerance", TOLERANCE), ("FollowJointTrajectoryGoal", GOAL),
                   ("FollowJointTrajectoryFeedback", FEEDBACK)):
    store.register(get_types_from_msg(text, f"control_msgs/msg/{name}"))
messages = Messages(make)
with Client.connect() as robot:
    JOINTS = robot.state("arm").name
    try_messages(robot)
    try_goals(robot)
    try_refusals(robot)
print("all is as it says")
