"""pylibfranka's joint motions on an emulated FR3: franka_pauses.py ADDRESS. Each line of the input is a goal [rad]; the
answers are `begun SECONDS`, and `done` or the error, from which it recovers."""

import sys
import time

import pylibfranka

VELOCITY = [2.0, 1.0, 1.5, 1.25, 3.0, 1.5, 3.0]
ACCELERATION = 7.0


def ease(t):
    return t * t * t * (10 - 15 * t + 6 * t * t)


def duration(start, goal):
    """Of the motion within these limits [s]."""
    far = [abs(b - a) for a, b in zip(start, goal)]
    return max(max(1.9 * d / v, (5.9 * d / ACCELERATION) ** 0.5) for d, v in zip(far, VELOCITY))


def move(robot, start, goal, seconds):
    control = robot.start_joint_position_control(pylibfranka.ControllerMode.JointImpedance)
    state, _ = control.readOnce()
    start, t = list(state.q_d), 0.0
    while True:
        part = ease(min(t / seconds, 1.0))
        command = pylibfranka.JointPositions([a + part * (b - a) for a, b in zip(start, goal)])
        command.motion_finished = t >= seconds + 0.05
        control.writeOnce(command)
        if command.motion_finished:
            return
        state, step = control.readOnce()
        t += step.to_sec()


def main(address):
    robot = pylibfranka.Robot(address, pylibfranka.RealtimeConfig.kIgnore)
    for line in sys.stdin:
        goal = [float(word) for word in line.split()]
        start = list(robot.read_once().q_d)
        seconds = duration(start, goal)
        print(f"begun {seconds}", flush=True)
        try:
            move(robot, start, goal, seconds)
            print("done", flush=True)
        except Exception as error:
            print(str(error).splitlines()[0], flush=True)
            time.sleep(0.1)
            robot.automatic_error_recovery()


main(sys.argv[1])
