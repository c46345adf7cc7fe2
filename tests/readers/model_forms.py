"""What other programs read in files of robots: URDF by Pinocchio (with urdfdom), meshes by trimesh, YAML by PyYAML."""

import json
import sys

asked = json.load(sys.stdin)


def robot(text):
    import pinocchio as pin

    try:
        model = pin.buildModelFromXML(text)
    except Exception:  # of several kinds, all of which refuse the text
        return None

    def finite(values):
        return [x if abs(x) < 1e300 else None for x in values.tolist()]

    place = pin.Quaternion(model.jointPlacements[1].rotation).coeffs().tolist()
    limits = [model.lowerPositionLimit, model.upperPositionLimit, model.velocityLimit, model.effortLimit]
    return {"quaternion": place, "limits": [finite(limit)[0] for limit in limits]}


def mesh(path):
    import trimesh

    try:
        read = trimesh.load(path, force="mesh", process=False)
        return {"triangles": len(read.faces), "bounds": read.bounds.tolist(), "volume": float(read.volume)}
    except Exception:
        return None


def yaml(text):
    import yaml as reader

    try:
        return {"value": reader.safe_load(text)}
    except reader.YAMLError:
        return None


read = {"robots": robot, "meshes": mesh, "texts": yaml}
json.dump({kind: [read[kind](one) for one in ones] for kind, ones in asked.items()}, sys.stdout)
