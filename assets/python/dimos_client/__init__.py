"""Talks to a run of dimos. Standard library only, Python 3.9 or newer; `pip install` it, or copy the folder.

    from dimos_client import Client

    with Client.connect() as robot:                          # the only live run; else Client.connect("its name")
        print(robot.state("arm").position)                   # rad
        robot.move("arm", [0.3, -0.2, 0.5, 0, 0.4, 0])       # waits; planned around obstacles if the run has a planner
        robot.gripper("arm", "close")                        # waits; .outcome: "holding", "closed", …

`run("coordinator-yourarm")` starts a simulated run that ends with the program, and returns its client.

Units are SI: rad, rad/s, Nm, m, N, s. Unknown values are None, never zero. docs/python.md has recipes, docs/rpc.md the
protocol; `call` sends every other request. A client is for one thread; make another for another thread. One connection
at a time may move an arm: LeaseHeld names the other one. Everything that waits has a bound, and so has every queue.
"""

from .client import Client
from .connection import KEPT, MAX_LINE
from .errors import (
    ArmNotReady,
    ConnectionLost,
    DimosError,
    LeaseHeld,
    MotionFailed,
    NoRun,
    OutOfLimits,
    OutOfReach,
    PlanningFailed,
    Refused,
)
from .live_runs import runs
from .own_run import OwnRun, run
from .records import ArmState, ChunkReport, Goal, Grip, JointState, LoopReport, Plan, Pose, Waypoint
from .streams import IN_FLIGHT, Policy

__all__ = [
    "IN_FLIGHT",
    "KEPT",
    "MAX_LINE",
    "ArmNotReady",
    "ArmState",
    "ChunkReport",
    "Client",
    "ConnectionLost",
    "DimosError",
    "Goal",
    "Grip",
    "JointState",
    "LeaseHeld",
    "LoopReport",
    "MotionFailed",
    "NoRun",
    "OutOfLimits",
    "OutOfReach",
    "OwnRun",
    "Plan",
    "PlanningFailed",
    "Policy",
    "Pose",
    "Refused",
    "Waypoint",
    "run",
    "runs",
]
