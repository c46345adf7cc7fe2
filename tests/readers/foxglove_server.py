"""Foxglove's own server, from its SDK. One JSON object on stdin: seconds, channels (topic, name and text of the schema,
message in base64), assets (URI: content in base64). Prints its port."""

import base64
import json
import sys
import time

from foxglove import Channel, Context, Schema, start_server

question = json.loads(sys.stdin.readline())
context = Context()
channels = [
    (
        Channel(
            row["topic"],
            message_encoding="cdr",
            schema=Schema(name=row["schemaName"], encoding="ros2msg", data=row["schema"].encode()),
            context=context,
        ),
        base64.b64decode(row["message"]),
    )
    for row in question["channels"]
]
assets = {uri: base64.b64decode(content) for uri, content in question["assets"].items()}
server = start_server(
    name="sdk",
    host="127.0.0.1",
    port=0,
    asset_handler=assets.get,
    context=context,
)
print(server.port, flush=True)
until = time.monotonic() + question["seconds"]
while time.monotonic() < until:
    for channel, message in channels:
        channel.log(message)
    time.sleep(0.05)
server.stop()
