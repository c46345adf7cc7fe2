"""Tries assets/python/dimos_client against a live run of tests/process/python_client.rs.

It fails at the first difference from its page.
"""

import itertools
import math
import os
import time

import dimos_client as dimos
from dimos_client import Client
from try_support import near, refused

READY = [0.1, -0.2, 0.3, 0.0, 0.2, 0.0]


def reads(robot):
    state = robot.state("arm")
    assert state.name == [f"arm_joint{i}" for i in range(1, 7)] and state.lost == 0
    assert len(state.position) == 6 and None not in state.position and 0 <= state.age < 30
    refused(dimos.Refused, "UNKNOWN_ARM", lambda: robot.state("rarm"))
    ticks = [s.tick for s in itertools.islice(robot.joint_states(rate=50), 25)]
    assert ticks == sorted(set(ticks)), ticks
    assert robot.status()["arms"][0]["commander"] is None, "readers take no lease"


def a_slow_reader_is_told(robot):
    states = robot.joint_states()
    first = next(states)
    (queue,) = robot._queues.values()
    while len(queue) < dimos.KEPT or not queue[0].get("lost"):
        robot.status()  # takes in what comes and reads none of it
    seen = [first, *itertools.islice(states, dimos.KEPT)]
    assert seen[1].lost > 0
    for before, after in zip(seen, seen[1:]):
        assert after.tick - before.tick >= 1 + after.lost, (before.tick, after)
    states.close()


def moves(robot):
    report = robot.move("arm", READY, speed=0.5)
    assert report["state"] == "COMPLETED" and near(robot.state("arm").position, READY, 0.02)
    assert report["collision_checked"] is False, "this run has no planner"
    refused(dimos.Refused, "NO_PLANNER", lambda: robot.move("arm", named="home"))
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.move("arm", named="home", direct=True))
    held = refused(dimos.LeaseHeld, "LEASE_HELD", lambda: Client.connect().move("arm", READY))
    assert held.data["pid"] == os.getpid() and "try_client.py" in held.data["program"], held.data
    far = refused(dimos.OutOfLimits, "OUT_OF_LIMITS", lambda: robot.move("arm", [99.0, *READY[1:]]))
    assert far.data["joint"] == "arm_joint1" and far.hint
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.move("arm", [math.nan] * 6))
    error = refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.gripper("arm", "closed"))
    assert "'closed' is no position of a gripper" in str(error), error
    points = [{"time_from_start": t, "positions": [READY[0] + 0.05 * t], "velocities": [0.0]} for t in (0, 1)]
    robot.execute({"joint_names": ["arm_joint1"], "points": points})
    begun = robot.move("arm", READY, wait=False)
    robot.cancel("arm")
    failed = refused(dimos.MotionFailed, "ABORTED", lambda: robot.wait(begun["motion"]))
    assert failed.data["done"]


def task_state(robot, name):
    return next(task["state"] for task in robot.status()["tasks"] if task["name"] == name)


def a_move_ends_the_streams_of_its_client(robot):
    """Also while these move the arm."""
    for _ in range(10):
        here = robot.state("arm").position
        robot.servo("servo_arm", [here[0] + 0.01, *here[1:]])
        time.sleep(0.02)
    assert robot.move("arm", READY)["state"] == "COMPLETED"
    robot.velocity("velocity_arm", [0.3, 0, 0, 0, 0, 0])
    time.sleep(0.15)
    robot.call("move", arm="arm", target=READY)  # any client of the protocol
    assert task_state(robot, "velocity_arm") == "IDLE"
    while task_state(robot, "traj_arm") == "EXECUTING":
        time.sleep(0.02)
    assert task_state(robot, "traj_arm") == "COMPLETED"


def follows_a_policy(robot, watcher):
    """50 Hz for 4 s: every target is taken, and the stream never goes stale."""
    home: list[float] = []
    asked = []
    seen = watcher._subscribe("events", None, 4096)

    def policy(state, t):
        if not home:
            home.extend(state.position)
        asked.append(t)
        return [home[0] + 0.1 * (1 - math.cos(2 * t)), *home[1:]]

    report = robot.follow("servo_arm", policy, rate=50, duration=4)
    print(f"50 Hz: {report}")
    assert report.sent == len(asked) and report.sent + report.missed in range(199, 202), report
    texts = []
    while "task servo_arm is IDLE: its stream was ended" not in texts:  # events come a little later
        watcher.status()
        texts = [m["data"]["text"] for m in watcher._queues[seen] if m["data"].get("task") == "servo_arm"]
    assert texts == ["task servo_arm is EXECUTING", "task servo_arm is IDLE: its stream was ended"], texts
    robot.move("arm", READY)  # at once: the stream has ended with its loop
    refused(dimos.Refused, "UNKNOWN_TASK", lambda: robot.follow("servo", lambda s, t: [0.0], duration=1))

    def fails(state, t):
        if t > 0.2:
            raise ZeroDivisionError
        return policy(state, t)

    home.clear()
    try:
        robot.follow("servo_arm", fails, rate=50)
    except ZeroDivisionError:
        assert task_state(robot, "servo_arm") == "IDLE"
    else:
        raise AssertionError("the policy's error is raised")
    robot.servo("servo_arm", [1.0])
    refused(dimos.Refused, "INVALID_PARAMS", robot.settle)
    robot.cancel()


def moves_the_end_effector(robot):
    """A twist about the base's z turns joint 1; a pose goes there and stays."""
    before = robot.state("arm").position
    for _ in range(25):
        robot.twist("twist_arm", [0, 0, 0.05], [0, 0, 0])
        time.sleep(0.02)
    robot.settle()
    after = robot.state("arm").position
    assert abs(after[0] - before[0]) < 1e-3 and not near(after[1:4], before[1:4], 0.01), (before, after)
    robot.twist("twist_arm", [0, 0, 0, 0], [0, 0, 0])
    refused(dimos.Refused, "INVALID_PARAMS", robot.settle)
    robot.twist("twist_arm", [0, 0, 0.05], [0, 0, 0], frame="world")
    refused(dimos.Refused, "INVALID_PARAMS", robot.settle)
    robot.pose("pose_arm", [0.35, 0, 0.3])
    refused(dimos.Refused, "INVALID_PARAMS", robot.settle)
    deadline = time.monotonic() + 60
    while True:  # until it is at rest there
        robot.pose("pose_arm", [0.35, 0.05, 0.4], rpy=[3.1, 0, 0.2])
        robot.settle()
        time.sleep(0.05)
        state = robot.state("arm")
        if max(abs(v) for v in state.velocity) < 1e-9 and abs(state.position[0] - before[0]) > 0.01:
            break
        assert time.monotonic() < deadline, state
    task = next(t for t in robot.status()["tasks"] if t["name"] == "pose_arm")
    assert task["state"] == "EXECUTING" and task["type"] == "cartesian_ik", task
    robot.pose("twist_arm", [0.35, 0.05, 0.4], quat=[0, 0, 0, 1])
    refused(dimos.Refused, "WRONG_TASK", robot.settle)
    robot.cancel()


def sets_outputs_and_payload(robot):
    assert robot.set_io("arm", do3=1, ao0=2.5)["digital_outputs"][3] is True
    assert robot.io("arm")["analog_inputs"][0] == {"value": 2.5, "unit": "V"}
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.set_io("arm", di0=1))
    for _ in range(250):  # the motion that was cancelled: a load is set at rest
        if max(abs(v) for v in robot.state("arm").velocity) < 0.005:
            break
        time.sleep(0.02)
    assert robot.set_payload("arm", 0.5, (0, 0, 0.05)) == robot.payload("arm")
    assert robot.payload("arm")["mass"] == 0.5


def grips_and_stops(robot):
    opened = robot.gripper("arm", "open")
    assert (opened.outcome, opened.unit, opened.holding) == ("open", "m", False), opened
    assert abs(opened.position - 0.08) < 1e-3
    assert robot.gripper("arm", 0.02, force=12.5).outcome == "reached"
    assert robot.gripper("arm", 0.03, wait=False).outcome == "moving"
    assert robot.gripper("arm", "close").outcome == "closed"
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.gripper("arm", "wide"))
    state = robot.state("arm")
    assert (state.gripper_unit, state.gripper_force, state.gripper_force_unit) == ("m", 0.0, "N"), state
    too_strong = refused(dimos.Refused, "OUT_OF_LIMITS", lambda: robot.gripper("arm", 0.04, force=1000))
    assert "to 40 N" in too_strong.hint, too_strong.hint
    robot.velocity("velocity_arm", [0.1, 0, 0, 0, 0, 0])
    robot.settle()
    assert robot.stop() == {"arm": "confirmed"}
    latched = refused(dimos.ArmNotReady, "ARM_LATCHED", lambda: robot.move("arm", READY))
    assert "dimos arm reset arm" in latched.hint
    assert robot.reset("arm") == "standby" and robot.enable("arm") == "ready"
    robot.move("arm", READY, speed=1)


refused(dimos.NoRun, "NO_RUN", lambda: Client.connect("another"))
with Client.connect() as robot, Client.connect("scripts") as watcher:
    reads(robot)
    a_slow_reader_is_told(watcher)
    moves(robot)
    follows_a_policy(robot, watcher)
    a_move_ends_the_streams_of_its_client(robot)
    moves_the_end_effector(robot)
    sets_outputs_and_payload(robot)
    grips_and_stops(robot)
    assert robot.call("release")["arms"] == ["arm"]
    watcher.move("arm", READY)
    robot.call("shutdown")
    refused(dimos.ConnectionLost, "NO_CONNECTION", lambda: [robot.status() for _ in range(100_000)])
print("all is as it says")
