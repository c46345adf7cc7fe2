"""What PyPI mcap reads in logs: read_foreign.py FILE... prints JSON lists, one for all files, of [topic, log time,
publish time, {joint: position}], in order of time, with `null` for what cannot be decoded. What is damaged is left out;
a wrong checksum alone damages nothing. `--csv FILE` prints [time, {column: value}] as pandas reads it, `--bag FOLDER`
how many messages rosbags reads on each topic."""

import json
import os
import sys

from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory


def read(path):
    schemas, channels, messages = {}, {}, []
    with open(path, "rb") as file:
        try:
            summary = make_reader(file).get_summary()
            schemas.update(summary.schemas)
            channels.update(summary.channels)
        except Exception:
            pass
        file.seek(0)

        def take(record):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                messages.append(record)

        records = StreamReader(file, emit_chunks=True, record_size_limit=None).records
        while True:
            try:
                record = next(records)
            except StopIteration:
                break
            except Exception:
                break
            if isinstance(record, Chunk):
                try:
                    for inner in breakup_chunk(record):
                        take(inner)
                except Exception:
                    pass
            else:
                take(record)
    found = []
    for message in messages:
        channel = channels[message.channel_id]
        decode = DecoderFactory().decoder_for("cdr", schemas[channel.schema_id])
        try:
            data = decode(message.data)
            values = dict(zip(data.name, data.position)) if len(data.name) < 100 and len(data.name[0]) < 100 else {}
        except Exception:
            values = None
        found.append([channel.topic, message.log_time, message.publish_time, values])
    return found


def about(path):
    with open(path, "rb") as file:
        reader = make_reader(file)
        attachments = {a.name: [len(a.data), a.data[:20].decode("latin1")] for a in reader.iter_attachments()}
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        topics = sorted(c.topic for c in reader.get_summary().channels.values())
        return {
            "attachments": attachments,
            "metadata": metadata,
            "topics": topics,
            "profile": reader.get_header().profile,
        }


def table(path):
    import pandas

    frame = pandas.read_csv(path, float_precision="round_trip")
    rows = []
    for row in frame.to_dict("records"):
        time = row.pop("time")
        rows.append([time, {name: value for name, value in row.items() if value == value}])
    return rows


def bag(path):
    from pathlib import Path

    from rosbags.highlevel import AnyReader

    counts: dict[str, int] = {}
    with AnyReader([Path(path)]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    return counts


if sys.argv[1] == "--bag":
    print(json.dumps(bag(sys.argv[2])))
elif sys.argv[1] == "--csv":
    print(json.dumps(table(sys.argv[2])))
elif sys.argv[1] == "--about":
    print(json.dumps(about(sys.argv[2])))
else:
    files = []
    for path in sys.argv[1:]:
        inside = sorted(os.listdir(path)) if os.path.isdir(path) else None
        files += (
            [os.path.join(path, name) for name in inside if name.endswith(".mcap")] if inside is not None else [path]
        )
    found = [message for path in files for message in read(path)]
    found.sort(key=lambda message: message[1])
    print(json.dumps(found))
