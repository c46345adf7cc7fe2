"""Writes what `dimos log export` reads from a log with the writers of the field: pyarrow, LeRobot.

`dimos_export.py parquet FILE` or `dimos_export.py lerobot FOLDER`. Standard input is a line of JSON that names the
columns, then rows of numbers of 8 bytes, little endian. It prints `ready` before it reads any, and ends with 3 if a
package is missing."""

import json
import sys
from collections.abc import Iterator
from typing import Any

ROWS = 65_536


def blocks(dtype: Any) -> Iterator[Any]:
    """The rows, some at a time."""
    import numpy

    while data := sys.stdin.buffer.read(ROWS * dtype.itemsize):
        yield numpy.frombuffer(data, dtype)


def parquet(target: str) -> None:
    """A table of numbers. NaN stays NaN: unknown."""
    import numpy
    import pyarrow
    import pyarrow.parquet

    columns = start()["columns"]
    dtype = numpy.dtype([(name, kind) for name, kind in columns])
    schema = pyarrow.schema([(name, pyarrow.from_numpy_dtype(dtype[name])) for name, _ in columns])
    with pyarrow.parquet.ParquetWriter(target, schema) as file:
        for block in blocks(dtype):
            arrays = [pyarrow.array(block[name].copy()) for name, _ in columns]
            file.write_table(pyarrow.table(arrays, schema=schema))


def lerobot(target: str) -> None:
    """A data set with one episode; a row has the states, then the actions."""
    import numpy
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    header = start()
    names = [f"{name}.pos" for name in header["names"]]
    width = len(names)
    feature = {"dtype": "float32", "shape": (width,), "names": names}
    data = LeRobotDataset.create(
        repo_id="dimos/export",
        fps=header["fps"],
        root=target,
        robot_type=header["robot_type"],
        use_videos=False,
        features={"observation.state": feature, "action": feature},
    )
    for block in blocks(numpy.dtype((numpy.float64, (2 * width,)))):
        for row in block.astype(numpy.float32):
            data.add_frame({"observation.state": row[:width], "action": row[width:], "task": header["task"]})
    data.save_episode()
    data.finalize()


def start() -> Any:
    """All packages are there: the caller may write."""
    print("ready", flush=True)
    return json.loads(sys.stdin.buffer.readline())


if __name__ == "__main__":
    kind, target = sys.argv[1:]
    try:
        {"parquet": parquet, "lerobot": lerobot}[kind](target)
    except ImportError as e:
        print(e, file=sys.stderr)
        sys.exit(3)
