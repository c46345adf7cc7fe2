"""Efforts, gravity and mass matrices of robots by Pinocchio. Mimic joints are joints of their own there; what they do
is folded into their leaders here."""

import json
import sys

import numpy as np
import pinocchio as pin


def answer(asked):
    model = pin.buildModelFromXML(asked["urdf"])
    model.gravity.linear = np.array(asked["gravity"])
    data = model.createData()
    names = asked["joints"]
    folding = np.zeros((model.nv, len(names)))
    for k, name in enumerate(names):
        folding[model.joints[model.getJointId(name)].idx_v, k] = 1
    for follower, leader, multiplier, _ in asked["mimic"]:
        folding[model.joints[model.getJointId(follower)].idx_v, names.index(leader)] = multiplier
    q = pin.neutral(model)
    at = dict(zip(names, asked["q"]))
    at |= {follower: multiplier * at[leader] + offset for follower, leader, multiplier, offset in asked["mimic"]}
    for name, value in at.items():
        joint = model.joints[model.getJointId(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
    qd, qdd = folding @ np.array(asked["qd"]), folding @ np.array(asked["qdd"])
    mass = pin.crba(model, data, q)
    mass = np.triu(mass) + np.triu(mass, 1).T
    return {
        "effort": (folding.T @ pin.rnea(model, data, q, qd, qdd)).tolist(),
        "gravity": (folding.T @ pin.computeGeneralizedGravity(model, data, q)).tolist(),
        "mass_matrix": (folding.T @ mass @ folding).tolist(),
    }


answers = []
for asked in json.load(sys.stdin):
    try:
        answers.append(answer(asked))
    except Exception as error:  # what Pinocchio refuses
        answers.append({"refused": str(error)})
json.dump(answers, sys.stdout)
