"""Rows of a Parquet file as JSON: the question has `file` and `columns`; the answer is a list of rows per column."""

import json
import sys

import pyarrow.parquet

question = json.load(sys.stdin)
table = pyarrow.parquet.read_table(question["file"], columns=question["columns"])
json.dump([table[name].to_pylist() for name in question["columns"]], sys.stdout)
