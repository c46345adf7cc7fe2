"""The vendor's SDK as another program beside the one that controls the arm: two calls with a pause between them.

Usage: piper_sdk_interferes.py CAN_INTERFACE

Reads lines "KIND MILLISECONDS" from stdin (KIND: pose, guiding, power), makes the two calls, answers "done".
"""

import sys
import time

from piper_sdk import C_PiperInterface_V2

piper = C_PiperInterface_V2("sim", judge_flag=False, can_auto_init=False)
CALLS = {
    # A pose 20 mm above the emulator's start.
    "pose": (
        lambda: piper.MotionCtrl_2(0x01, 0x00, 50, 0x00),
        lambda: piper.EndPoseCtrl(119145, 13734, 383413, -167006, 77515, -159832),
    ),
    "guiding": (lambda: piper.MotionCtrl_1(0, 0, 1), lambda: piper.MotionCtrl_1(0, 0, 2)),
    "power": (lambda: piper.DisableArm(7), lambda: piper.EnableArm(7)),
}
piper.CreateCanBus(sys.argv[1], bustype="socketcan", judge_flag=False)
piper.ConnectPort(piper_init=False)
print("ready", flush=True)
for line in sys.stdin:
    kind, pause = line.split()
    first, second = CALLS[kind]
    first()
    if float(pause) > 0:
        time.sleep(float(pause) / 1000)
    second()
    print("done", flush=True)
