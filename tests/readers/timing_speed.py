"""How long toppra takes, and how long its motions are: each path is given by waypoints, with limits for all joints."""

import json
import logging
import sys
import time
from importlib.metadata import version

import numpy as np
import toppra
import toppra.algorithm as algorithm
import toppra.constraint as constraint

logging.getLogger("toppra").setLevel(logging.ERROR)
asked = json.load(sys.stdin)
times, durations = [], []


def limit(value, joints):
    return np.tile([-value, value], (joints, 1))


for waypoints in asked["paths"]:
    began = time.perf_counter()
    q = np.array(waypoints)
    s = np.linspace(0.0, len(q) - 1.0, len(q))
    path = toppra.SplineInterpolator(s, q)
    limits = [
        constraint.JointVelocityConstraint(limit(asked["velocity"], q.shape[1])),
        constraint.JointAccelerationConstraint(limit(asked["acceleration"], q.shape[1])),
    ]
    # A grid point at each waypoint: its quickest, not its best.
    solver = algorithm.TOPPRA(limits, path, gridpoints=s, parametrizer="ParametrizeConstAccel")
    durations.append(float(solver.compute_trajectory(0, 0).duration))
    times.append(time.perf_counter() - began)
json.dump({"version": version("toppra"), "times": times, "durations": durations}, sys.stdout)
