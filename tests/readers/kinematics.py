"""Frames and Jacobians of a robot by Pinocchio, for configurations given on standard input."""

import json
import sys

import numpy as np
import pinocchio as pin

asked = json.load(sys.stdin)
model = pin.buildModelFromUrdf(asked["urdf"])
data = model.createData()
answers = []
for positions in asked["configurations"]:
    q = pin.neutral(model)
    for name, value in positions.items():
        joint = model.joints[model.getJointId(name)]
        # A joint without limits is a point on the unit circle.
        q[joint.idx_q : joint.idx_q + joint.nq] = [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    links = {}
    for name in asked["links"]:
        frame = model.getFrameId(name, pin.BODY)
        place = data.oMf[frame]
        jacobian = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        columns = {n: jacobian[:, model.joints[i].idx_v].tolist() for i, n in enumerate(model.names) if i > 0}
        links[name] = {
            "rotation": place.rotation.tolist(),
            "translation": place.translation.tolist(),
            "jacobian": columns,
        }
    answers.append(links)
json.dump(answers, sys.stdout)
