"""Tries waypoints, distances and frames of the client against a live run of the blueprint of docs/python.md."""

import dimos_client as dimos
from dimos_client import Client, Goal, Pose
from try_support import near, refused

HOME = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0]


def waypoints_and_distances(robot):
    aside = Pose([0.35, 0.05, 0.35], rpy=[3.14, 0.2, 0])
    way = [[0.3, -0.2, 0.5, 0.1, 0.8, 0], Goal(pose=aside, linear=True), "home"]
    slow, fast = robot.plan("arm", through=way, speed=1.0), robot.plan("arm", through=way, blend=0.03, speed=1.0)
    assert fast.duration < slow.duration, (fast, slow)
    samples = robot.preview(hz=50)
    assert samples["plan"] == fast.number and len(samples["trajectory"]["points"]) > 50 * fast.duration
    # The plan of a move is its own: `execute` takes that of `plan`.
    robot.move("arm", through=way, blend=0.03, speed=1.0)
    assert near(robot.state("arm").position, HOME) and robot.preview()["plan"] == fast.number
    line = robot.preview(robot.plan("arm", by=Pose([0, 0, 0.05]), frame="map", linear=True))["end_effectors"]["arm"]
    assert near([b - a for a, b in zip(line[0], line[-1])], [0, 0, 0.05], 1e-3), line
    robot.move("arm", pose=Pose([0, 0, -0.02]), frame="tool", speed=1.0)
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.move("arm", HOME, through=way))
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.move({"arm": Goal(joints=HOME)}, through=way))
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.move("arm", by=Pose([0, 0, 0.1]), named="home"))


with Client.connect() as robot:
    robot.move("arm", named="home", speed=1.0)
    waypoints_and_distances(robot)
print("all is as it says")
