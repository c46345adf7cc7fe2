"""A double of LeRobot's data set, which needs torch: keeps what it is given in `frames.json`. Calls have the names and
parameters of the real one, whose source is installed. `make test-lerobot` writes with the real one."""

import ast
import json
import sysconfig
from pathlib import Path

SOURCE = Path(sysconfig.get_paths()["purelib"]) / "lerobot/datasets/lerobot_dataset.py"
REAL = next(c for c in ast.parse(SOURCE.read_text()).body if isinstance(c, ast.ClassDef) and c.name == "LeRobotDataset")
METHODS = {f.name: [a.arg for a in f.args.args] for f in REAL.body if isinstance(f, ast.FunctionDef)}


class LeRobotDataset:
    def __init__(self, settings):
        self.settings, self.frames = settings, []

    @classmethod
    def create(cls, **settings):
        assert settings.keys() <= set(METHODS["create"]), settings
        Path(settings["root"]).mkdir()
        return cls(settings)

    def add_frame(self, frame):
        assert METHODS["add_frame"] == ["self", "frame"] and frame["action"].dtype == "float32"
        self.frames.append({name: value if name == "task" else value.tolist() for name, value in frame.items()})

    def save_episode(self):
        assert METHODS["save_episode"][0] == "self"

    def finalize(self):
        assert METHODS["finalize"] == ["self"]
        (Path(self.settings["root"]) / "frames.json").write_text(json.dumps([self.settings, self.frames]))
