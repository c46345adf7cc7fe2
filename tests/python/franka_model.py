"""The vendor's clients load the model of an emulated arm: franka_model.py pylibfranka|franky|panda_py ADDRESS. `franky`
moves the arm, too; the compiled model that `panda_py` asks for is refused at once."""

import math
import sys
import time

START = [0.2, -0.6, 0.1, -1.9, -0.15, 1.7, 0.8]


def check(what, holds):
    if not holds:
        sys.exit(f"wrong: {what}")


def near(a, b, by):
    return all(abs(x - y) < by for x, y in zip(a, b, strict=True))


def pylibfranka(address):
    import pylibfranka as it

    robot = it.Robot(address, it.RealtimeConfig.kIgnore)
    model, state = robot.load_model(), robot.read_once()
    jacobian = list(model.zero_jacobian(state))
    # The first joint turns the flange about the vertical through the base.
    x, y = state.O_T_EE[12:14]
    check(f"jacobian {jacobian[:6]} at {x} {y}", near(jacobian[:6], [-y, x, 0, 0, 0, 1], 1e-5))
    gravity = list(model.gravity(state))
    # The fourth joint carries the forearm; the first turns about the vertical.
    check(f"gravity {gravity}", abs(gravity[0]) < 1e-6 and 10.0 < gravity[3] < 25.0)
    mass = list(model.mass(state))
    check(f"mass {mass}", len(mass) == 49 and all(mass[8 * i] > 1e-4 for i in range(7)))


def franky(address):
    import franky as it

    robot = it.Robot(address, realtime_config=it.RealtimeConfig.Ignore)
    check(f"q {robot.state.q}", near(robot.state.q, START, 1e-5))
    flange = robot.model.pose(it.Frame.Flange, robot.state)
    check(f"flange {flange}", near(flange.translation, robot.state.O_T_EE.translation, 1e-5))
    robot.relative_dynamics_factor = 0.1
    goal = [q + 0.1 for q in START]
    robot.move(it.JointMotion(goal))
    check(f"moved to {robot.state.q}", near(robot.state.q, goal, 2e-3))


def panda_py(address):
    from panda_py import libfranka

    robot = libfranka.Robot(address, libfranka.RealtimeConfig.kIgnore)
    began = time.monotonic()
    try:
        robot.load_model()
        check("the compiled model is refused", False)
    except Exception as error:
        check(f"the model in {error!r}", "model" in str(error).lower())
    check("refused at once", time.monotonic() - began < 1.0)
    # The connection continues.
    check("a state", math.isfinite(sum(robot.read_once().q)))


globals()[sys.argv[1]](sys.argv[2])
print("all is as it says")
