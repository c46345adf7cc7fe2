"""Loads a data set with LeRobot itself: `make test-lerobot`.

usage: load_lerobot.py FOLDER
"""

import sys
from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset

folder = Path(sys.argv[1])
data = LeRobotDataset("dimos/test", root=folder)
assert data.num_episodes == 1 and len(data) == data.num_frames == data.meta.total_frames, data
first, last = data[0], data[len(data) - 1]
width = data.features["observation.state"]["shape"][0]
assert first["observation.state"].shape == first["action"].shape == (width,)
assert first["task"] == "wave" and first["frame_index"] == 0 and last["frame_index"] == len(data) - 1
assert abs(last["timestamp"] - (len(data) - 1) / data.fps) < 1e-4
assert data.meta.stats["action"]["mean"].shape == (width,)
print(f"{len(data)} frames at {data.fps} Hz are loaded")
