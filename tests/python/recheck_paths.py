"""Judges the paths that the planning benchmark wrote, with somebody else's kinematics and collision checks: Pinocchio
and coal (PyPI `pin`). Every path is walked in steps of 1/128 rad, every triangle of every mesh counts. A problem may
name pairs of links that are `ignored`, and where joints that are not planned `rest`.

    python recheck_paths.py --rows rows.json --problems problems.jsonl --urdf panda.urdf --package panda=DIR
"""

import argparse
import json
import math
import tempfile
import xml.etree.ElementTree as xml
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

STEP = 1 / 128


def shape(thing):
    size = thing["size"]
    kinds = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}
    return kinds[thing["type"]](*size)


def pose(thing):
    return pin.SE3(pin.Quaternion(np.array(thing["quat_xyzw"])).normalized(), np.array(thing["position"]))


class Robot:
    """The arm with its sliding joints, a gripper's, open."""

    def __init__(self, path, packages):
        text = Path(path).read_text()
        for package in packages:
            name, folder = package.split("=", 1)
            text = text.replace(f"package://{name}/", f"file://{folder}/")
        self.model = pin.buildModelFromXML(text)
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
            file.write(text.replace("file://", ""))
            file.flush()
            self.links = pin.buildGeomFromUrdf(self.model, file.name, pin.GeometryType.COLLISION)
        root = xml.fromstring(text)
        ends = [(j.find("parent"), j.find("child")) for j in root.iter("joint")]
        self.neighbours = {
            frozenset((a.get("link"), b.get("link"))) for a, b in ends if a is not None and b is not None
        }
        self.rest = pin.neutral(self.model)
        for j in range(1, self.model.njoints):
            if self.model.joints[j].shortname().startswith("JointModelP"):
                i = self.model.joints[j].idx_q
                self.rest[i] = self.model.upperPositionLimit[i]

    def link(self, geometry):
        return self.model.frames[geometry.parentFrame].name

    def own_name(self, name):
        ends = [n for n in self.model.names if n == name] or [
            n for n in self.model.names if n.split("_", 1)[-1] == name.split("_", 1)[-1]
        ]
        assert len(ends) == 1, (name, ends)
        return ends[0]

    def joint(self, name):
        return self.model.joints[self.model.getJointId(self.own_name(name))].idx_q

    def scene(self, problem):
        geometry = self.links.copy()
        planned = {self.model.getJointId(self.own_name(name)) for name in problem["joints"]}

        def mover(thing):
            joint = thing.parentJoint
            while joint != 0 and joint not in planned:
                joint = self.model.parents[joint]
            return joint

        ignored = {frozenset(pair) for pair in problem.get("ignored", [])}
        count = geometry.ngeoms
        for thing in problem["obstacles"]:
            geometry.addGeometryObject(pin.GeometryObject(thing["name"], 0, 0, pose(thing), shape(thing)))
        objects = geometry.geometryObjects
        for a in range(count):
            for b in range(a):
                one, two = objects[a], objects[b]
                pair = frozenset((self.link(one), self.link(two)))
                near = pair in self.neighbours or pair in ignored
                if mover(one) != mover(two) and not near:
                    geometry.addCollisionPair(pin.CollisionPair(b, a))
            # What never moves cannot be helped.
            if mover(objects[a]) != 0:
                for o in range(count, geometry.ngeoms):
                    geometry.addCollisionPair(pin.CollisionPair(a, o))
        return geometry


class Judge:
    """One problem's scene."""

    def __init__(self, robot, problem):
        self.robot, self.geometry = robot, robot.scene(problem)
        self.data, self.checks = robot.model.createData(), self.geometry.createData()
        self.at = [robot.joint(name) for name in problem["joints"]]
        self.rest = robot.rest.copy()
        for name, position in problem.get("rest", {}).items():
            self.rest[robot.joint(name)] = position

    def touches(self, q, everything=False):
        full = self.rest.copy()
        full[self.at] = q
        hit = pin.computeCollisions(self.robot.model, self.data, self.geometry, self.checks, full, not everything)
        if not hit:
            return []

        def name(i):
            return self.geometry.geometryObjects[i].name

        pairs = enumerate(self.geometry.collisionPairs)
        return [
            f"{name(p.first)} and {name(p.second)}" for i, p in pairs if self.checks.collisionResults[i].isCollision()
        ]

    def outside(self, q):
        low, high = self.robot.model.lowerPositionLimit[self.at], self.robot.model.upperPositionLimit[self.at]
        return [i for i in range(len(q)) if not low[i] <= q[i] <= high[i]]


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ["rows", "problems", "urdf"]:
        arguments.add_argument(f"--{name}", required=True)
    arguments.add_argument("--package", action="append", default=[])
    arguments.add_argument("--every", type=int, default=1, help="only one path in N")
    given = arguments.parse_args()
    robot = Robot(given.urdf, given.package)
    lines = Path(given.problems).read_text().splitlines()
    problems = {(p["problem"], p["index"]): p for p in map(json.loads, lines)}
    rows = json.loads(Path(given.rows).read_text())["rows"]
    judged, touching, looks, unsolved = 0, 0, 0, 0
    explained: dict[str, int] = {}
    for number, row in enumerate(rows):
        if row["solved"] and number % given.every:
            continue
        problem = problems[row["problem"], row["index"]]
        judge = Judge(robot, problem)
        if not row["solved"]:
            unsolved += 1
            ends = [(end, problem[end]) for end in ["start", "goal"]]
            why = [f"{end} touches" for end, q in ends if judge.touches(q)]
            why += [f"{end} outside its limits" for end, q in ends if judge.outside(q)]
            explained[", ".join(why) or "no reason"] = explained.get(", ".join(why) or "no reason", 0) + 1
            continue
        judged += 1
        path = [np.array(q) for q in row["path"]]
        ends = np.allclose(path[0], problem["start"]) and np.allclose(path[-1], problem["goal"], atol=1e-6)
        found = [] if ends else ["other ends"]
        for a, b in zip(path, path[1:]):
            steps = max(1, math.ceil(np.linalg.norm(b - a) / STEP))
            for k in range(steps + 1):
                looks += 1
                # The end itself: rounding may put it beyond a limit.
                q = b if k == steps else a + (b - a) * (k / steps)
                found = found or judge.touches(q) or [f"joint {i} outside" for i in judge.outside(q)]
        if found:
            touching += 1
            print(row["problem"], row["index"], found)
    print(f"{judged} paths, {looks} configurations: {touching} touch; {unsolved} unsolved: {explained}")


main()
