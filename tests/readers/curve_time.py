"""The shortest duration of motions along curves, from rest to rest, with velocity, acceleration and jerk limits of the
joints, by CasADi and Ipopt: the parameter's jerk is constant in each of many equal intervals of time, whose length is
free. A curve is given by dense samples or, if `natural`, is the natural cubic spline through a few."""

import json
import sys

import casadi as ca
import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline

INTERVALS = 90
PLACES = 2  # per interval where limits hold


def curve_of(case):
    q = np.array(case["q"])
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(s) > 1e-12])
    s, q = s[keep], q[keep]
    if case.get("natural"):
        return s[-1], CubicSpline(s, q, bc_type="natural")
    return s[-1], make_interp_spline(s, q, k=min(5, len(s) - 1))


def shortest(case):
    length, spline = curve_of(case)
    limits = [np.array(case[key]) for key in ("velocity", "acceleration", "jerk")]
    grid = np.linspace(0, length, 400)
    values = [spline.derivative(k)(grid) for k in (1, 2, 3)]
    of = [ca.interpolant(f"d{k}", "bspline" if k < 2 else "linear", [grid], v.ravel()) for k, v in enumerate(values)]
    opti = ca.Opti()
    duration = opti.variable()
    x = opti.variable(3, INTERVALS + 1)
    u = opti.variable(INTERVALS)
    h = duration / INTERVALS

    def ahead(at, jerk, t):
        s, v, a = at[0], at[1], at[2]
        return s + t * (v + t * (a / 2 + t * jerk / 6)), v + t * (a + t * jerk / 2), a + t * jerk

    for k in range(INTERVALS):
        at, jerk = x[:, k], u[k]
        opti.subject_to(x[:, k + 1] == ca.vertcat(*ahead(at, jerk, h)))
        for place in range(PLACES):
            s, v, a = ahead(at, jerk, h * place / PLACES)
            d1, d2, d3 = (f(s) for f in of)
            needs = [d1 * v, d1 * a + d2 * v**2, d1 * jerk + 3 * d2 * v * a + d3 * v**3]
            for need, limit in zip(needs, limits):
                opti.subject_to(opti.bounded(-1, need / limit, 1))
        opti.subject_to(x[1, k] >= 0)
    opti.subject_to(x[:, 0] == ca.vertcat(0, 0, 0))
    opti.subject_to(x[:, -1] == ca.vertcat(length, 0, 0))
    opti.subject_to(duration >= 1e-2)
    opti.minimize(duration)
    # A slow and smooth motion.
    t = np.linspace(0, 1, INTERVALS + 1)
    guess = case["duration"] * 1.5
    opti.set_initial(duration, guess)
    opti.set_initial(x[0, :], length * (10 * t**3 - 15 * t**4 + 6 * t**5))
    opti.set_initial(x[1, :], length / guess * (30 * t**2 - 60 * t**3 + 30 * t**4))
    opti.set_initial(x[2, :], length / guess**2 * (60 * t - 180 * t**2 + 120 * t**3))
    options = {"print_level": 0, "max_iter": 400, "tol": 1e-6, "acceptable_tol": 1e-5, "linear_solver": "mumps"}
    opti.solver("ipopt", {"print_time": False, "ipopt": {**options, "sb": "yes"}})
    try:
        return float(opti.solve().value(duration))
    except RuntimeError:
        return None


json.dump([shortest(case) for case in json.load(sys.stdin)], sys.stdout)
