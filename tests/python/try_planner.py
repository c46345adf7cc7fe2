"""Tries the planning part of assets/python/dimos_client against a live run of the blueprint of docs/python.md."""

import time

import dimos_client as dimos
from dimos_client import Client, Goal, Pose
from try_support import near, refused

HOME = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0]
ASIDE = [1.0, -0.3, 0.6, 0.0, 0.8, 0.0]


def is_at(robot, goal):
    return near(robot.state("arm").position, goal)


def a_motion_that_is_not_planned_is_refused(robot):
    assert robot.move("arm", HOME, 1.0)["collision_checked"] is True
    error = refused(dimos.Refused, "NOT_PLANNED", lambda: robot.call("move", arm="arm", target=ASIDE))
    assert "direct" in error.hint and is_at(robot, HOME), error
    for joints in (ASIDE, HOME):
        assert robot.move("arm", joints, 1.0, direct=True)["collision_checked"] is False
        assert is_at(robot, joints)
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.move("arm", named="home", direct=True))


def motions_go_around(robot):
    """The post is on the straight way in joint space."""
    robot.world_add("post", box=[0.04, 0.04, 0.4], xyz=[0.22, 0.12, 0.2])
    plan = robot.plan("arm", ASIDE, seed=1)
    assert plan.summary["waypoints"] > 2 and plan.clearance > 0 and is_at(robot, HOME), plan
    preview = robot.preview(plan)
    assert preview["plan"] == plan.number and len(preview["end_effectors"]["arm"]) > 2
    assert robot.execute(plan)["collision_checked"] is True and is_at(robot, ASIDE)
    robot.move({"arm": Goal(named="home")}, speed=1.0)
    assert is_at(robot, HOME) and robot.named_poses("arm")["home"] == HOME
    robot.world_move("post", [0.24, 0.0, 0.3])
    failed = refused(dimos.PlanningFailed, "FAILED", lambda: robot.plan("arm", ASIDE))
    assert "post" in failed.message and failed.hint, failed
    robot.world_remove("post")
    assert "post" not in [thing["name"] for thing in robot.world_list()]


def poses_and_several_goals(robot):
    pose = Pose([0.35, 0.1, 0.3], rpy=[3.14, 0, 0])
    robot.move("arm", pose=pose, speed=1.0)
    error = refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.move("arm", pose=[0.35, 0.1, 0.3]))
    assert "must be a Pose" in str(error), error
    line = robot.plan("arm", pose=Pose([0.35, 0.15, 0.3], rpy=[3.14, 0, 0]), linear=True)
    assert line.summary["fraction"] == 1.0, line
    assert not robot.cancel_plan(line), "it is planned already"
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.plan({"arm": Goal(pose=pose)}, HOME))
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.plan("arm", HOME, named="home"))
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.world_add("two", sphere=0.1, box=[1, 1, 1]))
    refused(dimos.Refused, "UNKNOWN_ROBOT", lambda: robot.named_poses("amr"))
    robot.call("pose_save", name="here")
    assert is_at(robot, robot.named_poses("arm")["here"])
    robot.call("pose_remove", name="here")
    refused(dimos.Refused, "INVALID_PARAMS", lambda: robot.move("arm", "home"))


def carries_an_object(robot):
    robot.world_add("cup", cylinder=[0.02, 0.06], xyz=[0.35, 0.1, 0.2])
    robot.attach("cup", "arm", touch_links=["link6"])
    cup = next(thing for thing in robot.world_list() if thing["name"] == "cup")
    assert cup["held_by"][0] == "arm", cup
    refused(dimos.Refused, "UNKNOWN_OBJECT", lambda: robot.gripper("arm", "close", attach="cap"))
    robot.detach("cup")
    robot.world_remove()
    assert robot.world_list() == []


def a_planned_move_ends_the_streams_of_its_client(robot):
    for _ in range(25):
        robot.twist("twist_arm", [0, 0, 0.05], [0, 0, 0])
        time.sleep(0.02)
    assert robot.move("arm", named="home", speed=1.0)["state"] == "COMPLETED"  # while the arm moves up
    assert is_at(robot, HOME)
    robot.follow("servo_arm", lambda state, t: [state.position[0] + 0.01, *state.position[1:]], 50, 0.4)
    robot.execute(robot.plan("arm", named="home"))
    assert is_at(robot, HOME)


with Client.connect() as robot:
    a_motion_that_is_not_planned_is_refused(robot)
    motions_go_around(robot)
    poses_and_several_goals(robot)
    carries_an_object(robot)
    a_planned_move_ends_the_streams_of_its_client(robot)
print("all is as it says")
