"""The vendor's SDK as its demos use it: connects, reads, enables, moves, grips, clears errors, disables.

Usage: piper_sdk_moves.py SERIAL_DEVICE|CAN_INTERFACE
"""

import sys
import time

from piper_sdk import C_PiperInterface_V2

TIMEOUT = 30.0  # [s] for anything that must happen


def until(what, holds):
    end = time.monotonic() + TIMEOUT
    while not holds():
        if time.monotonic() > end:
            sys.exit(f"not within {TIMEOUT} s: {what}")
        time.sleep(0.01)


def near(values, expected, tolerance):
    return all(abs(a - b) <= tolerance for a, b in zip(values, expected))


def joints():
    state = piper.GetArmJointMsgs().joint_state
    return [getattr(state, f"joint_{i}") for i in range(1, 7)]  # [0.001 deg]


def pose():
    state = piper.GetArmEndPoseMsgs().end_pose
    return [getattr(state, f"{axis}_axis") for axis in ("X", "Y", "Z", "RX", "RY", "RZ")]  # [0.001 mm, 0.001 deg]


def status():
    return piper.GetArmStatus().arm_status


def enabled():
    return piper.GetArmEnableStatus()


def move(target, speed):
    """Repeats the target, as the vendor's demos do, until the arm is there."""

    def there():
        piper.MotionCtrl_2(0x01, 0x01, speed, 0x00)
        piper.JointCtrl(*target)
        return near(joints(), target, 20)

    until(f"the joints at {target}", there)


piper = C_PiperInterface_V2("sim", judge_flag=False, can_auto_init=False)
kind = "slcan" if sys.argv[1].startswith("/") else "socketcan"
piper.CreateCanBus(sys.argv[1], bustype=kind, judge_flag=False)
piper.ConnectPort(piper_init=True)

# Identity and state.
until("the state", lambda: near(joints(), [5730, 34377, -40107, 2865, 22918, -5730], 1))
until("the pose", lambda: near(pose(), [119145, 13734, 363413, -167006, 77515, -159832], 60))


def firmware():
    piper.SearchPiperFirmwareVersion()
    time.sleep(0.2)
    return piper.GetPiperFirmwareVersion() == "S-V1.6-3"


until("the firmware", firmware)
until("a gripper half open", lambda: abs(piper.GetArmGripperMsgs().gripper_state.grippers_angle - 35000) < 10)
assert enabled() == [False] * 6, enabled()


def limits():
    piper.SearchMotorMaxAngleSpdAccLimit(3, 0x01)
    time.sleep(0.1)
    limit = piper.GetCurrentMotorAngleLimitMaxVel().current_motor_angle_limit_max_vel
    return (limit.motor_num, limit.max_angle_limit, limit.min_angle_limit, limit.max_joint_spd) == (3, 0, -1700, 3000)


until("the limits of joint 3", limits)

# Motors on, as the vendor does it: asked for until it is so.
until("the motors", piper.EnablePiper)
assert all(enabled())

# Joints, the SDK's own forward kinematics, and speeds from the motors.
piper.EnableFkCal()
move([30000, 60000, -50000, -5000, 20000, 10000], 60)
until("standstill", lambda: int(status().motion_status) == 0)
assert int(status().ctrl_mode) == 1 and int(status().mode_feed) == 1 and int(status().arm_status) == 0, str(status())
until("the SDK's own kinematics", lambda: near([v * 1000 for v in piper.GetFK("feedback")[-1]], pose(), 150))

# A pose, 20 mm higher.
goal = pose()
goal[2] += 20000


def higher():
    piper.MotionCtrl_2(0x01, 0x00, 50, 0x00)
    piper.EndPoseCtrl(*goal)
    return near(pose()[:3], goal[:3], 100)


until("the pose 20 mm higher", higher)

# The gripper, 60 mm with 1 Nm.
piper.GripperCtrl(60000, 1000, 0x01, 0)
until("the gripper", lambda: abs(piper.GetArmGripperMsgs().gripper_state.grippers_angle - 60000) < 50)

# Streamed at 50 Hz; the speeds show it.
target = joints()
fastest = 0
for _ in range(50):
    target[0] += 400  # 20 deg/s
    piper.MotionCtrl_2(0x01, 0x01, 100, 0x00)
    piper.JointCtrl(*target)
    fastest = max(fastest, piper.GetArmHighSpdInfoMsgs().motor_1.motor_speed)
    time.sleep(0.02)
assert 200 < fastest < 1000, f"0.35 rad/s expected, {fastest / 1000} rad/s seen"

# Errors: a target beyond the limits of a mode that is not there, and cleared without a fall.
piper.MotionCtrl_2(0x01, 0x04, 50, 0xAD)
until("the refusal", lambda: int(status().arm_status) == 10)
piper.JointConfig(7, 0, 0, 500, 0xAE)
until("no error", lambda: int(status().arm_status) == 0)
assert all(enabled()), "clearing an error leaves the motors on"

# Home of this test; then off, where the arm's joints lie in its folded pose or are held by friction.
move([20000, 50000, -40000, 5000, 25000, -10000], 80)
until("the motors off", lambda: not piper.DisablePiper())
piper.DisconnectPort()
print("all is as it says")
