// Reads a log with the code that Foxglove reads it with, and compares every message with what dimos reads.
//
// usage: node read_log.mjs LOG EXPECTED, where EXPECTED has one JSON object per message: topic, log_time, data.

import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader } from "@mcap/core";
import { decompress } from "fzstd";
import assert from "node:assert/strict";
import { open, readFile } from "node:fs/promises";

const [log, expectedPath] = process.argv.slice(2);

// A decoded message as JSON would have it: NaN is null, 64-bit integers are numbers.
function plain(value) {
  if (typeof value === "bigint") return Number(value);
  if (typeof value === "number") return Number.isNaN(value) ? null : value;
  if (ArrayBuffer.isView(value) || Array.isArray(value)) return Array.from(value, plain);
  if (value === null || typeof value !== "object") return value;
  const entries = Object.entries(value).map(([k, v]) => [k === "nsec" ? "nanosec" : k, plain(v)]);
  return Object.fromEntries(entries);
}

const expected = new Map();
for (const line of (await readFile(expectedPath, "utf8")).trim().split("\n")) {
  const { topic, log_time, data } = JSON.parse(line);
  if (!expected.has(topic)) expected.set(topic, []);
  expected.get(topic).push({ log_time, data });
}

const file = await open(log);
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const bytes = new Uint8Array(Number(length));
    await file.read(bytes, 0, bytes.length, Number(offset));
    return bytes;
  },
};
const reader = await McapIndexedReader.Initialize({
  readable,
  decompressHandlers: { zstd: (bytes, size) => decompress(bytes, new Uint8Array(Number(size))) },
});
assert.equal(reader.header.profile, "ros2");

const decoders = new Map();
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  assert.equal(schema.encoding, "ros2msg");
  assert.equal(channel.messageEncoding, "cdr");
  const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
  decoders.set(channel.id, new MessageReader(definition));
}

const found = new Map();
let count = 0;
for await (const message of reader.readMessages()) {
  const { topic } = reader.channelsById.get(message.channelId);
  if (!found.has(topic)) found.set(topic, []);
  const data = plain(decoders.get(message.channelId).readMessage(message.data));
  found.get(topic).push({ log_time: Number(message.logTime), data });
  count += 1;
}
await file.close();

assert.deepEqual([...found.keys()].sort(), [...expected.keys()].sort());
for (const [topic, messages] of expected) {
  assert.deepEqual(found.get(topic), messages, topic);
}
console.log(`@mcap/core: ${count} messages on ${found.size} topics are the same`);
