"""The shortest duration of curves by toppra: each is given by dense samples, with velocity and acceleration limits."""

import json
import logging
import sys

import numpy as np
import toppra
import toppra.algorithm as algorithm
import toppra.constraint as constraint

logging.getLogger("toppra").setLevel(logging.ERROR)


def limit(values):
    return np.array([[-v, v] for v in values])


durations = []
for curve in json.load(sys.stdin):
    s, q = np.array(curve["s"]), np.array(curve["q"])
    path = toppra.SplineInterpolator(s, q)
    acceleration = constraint.JointAccelerationConstraint(
        limit(curve["acceleration"]), discretization_scheme=constraint.DiscretizationType.Interpolation
    )
    limits = [constraint.JointVelocityConstraint(limit(curve["velocity"])), acceleration]
    solver = algorithm.TOPPRA(limits, path, gridpoints=s, parametrizer="ParametrizeConstAccel")
    durations.append(float(solver.compute_trajectory(0, 0).duration))
json.dump(durations, sys.stdout)
