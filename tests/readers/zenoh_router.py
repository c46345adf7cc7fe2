"""A router of zenoh at a port of this computer, until standard input ends: what rmw_zenohd is to nodes of ROS 2."""

import json
import sys

import zenoh

config = zenoh.Config()
for key, value in {
    "mode": "router",
    "listen/endpoints": [f"tcp/127.0.0.1:{sys.argv[1]}"],
    "scouting/multicast/enabled": False,
}.items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("ready", flush=True)
    sys.stdin.read()
