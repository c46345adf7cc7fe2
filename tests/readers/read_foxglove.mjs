// Reads a server of Foxglove's WebSocket with Foxglove's own client, and decodes its messages with the code that
// Foxglove decodes them with.
//
// usage: node read_foxglove.mjs URL SUBPROTOCOL ORDERS, where ORDERS is JSON: topics (one message of each is awaited),
// fetch (URIs of files), meddle (whether to try what only a commander may). Prints one JSON object.

import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import protocol from "@foxglove/ws-protocol";
import assert from "node:assert/strict";
import { WebSocket } from "ws";

const { FoxgloveClient } = protocol;
const [url, subprotocol, orders] = process.argv.slice(2);
const { topics, fetch = [], meddle = false, origin } = JSON.parse(orders);
const socket = new WebSocket(url, [subprotocol], origin ? { origin } : {});
const client = new FoxgloveClient({ ws: socket });
const found = { channels: {}, messages: {}, raw: {}, statuses: [], assets: {} };
const readers = new Map();
const LIMIT = 30_000;

// A decoded message as JSON has it.
function plain(value) {
  if (typeof value === "bigint") return Number(value);
  if (typeof value === "number") return Number.isNaN(value) ? null : value;
  if (ArrayBuffer.isView(value) || Array.isArray(value)) return Array.from(value, plain);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, plain(v)]));
}

const timer = setTimeout(() => {
  console.error(`not within ${LIMIT / 1000} s: ${JSON.stringify({ ...found, raw: undefined }).slice(0, 2000)}`);
  process.exit(1);
}, LIMIT);
client.on("error", (error) => {
  console.error(`error: ${error.message}`);
  process.exit(1);
});
client.on("serverInfo", (info) => {
  found.serverInfo = info;
  found.protocol = socket.protocol;
});
client.on("advertise", (channels) => {
  for (const channel of channels) {
    const { id, topic, ...rest } = channel;
    found.channels[topic] = rest;
    if (!topics.includes(topic)) continue;
    assert.equal(channel.encoding, "cdr");
    assert.equal(channel.schemaEncoding, "ros2msg");
    const definition = parse(channel.schema, { ros2: true });
    readers.set(client.subscribe(id), { topic, reader: new MessageReader(definition) });
  }
  if (meddle) {
    client.advertise({ topic: "/cmd", encoding: "json", schemaName: "x" });
    client.sendMessage(1, new Uint8Array([1]));
    client.setParameters([{ name: "a", value: 1 }]);
    client.sendServiceCallRequest({ serviceId: 1, callId: 1, encoding: "cdr", data: new DataView(new ArrayBuffer(1)) });
    client.subscribe(1000);
  }
  fetch.forEach((uri, index) => client.fetchAsset(uri, index));
});
client.on("status", (status) => {
  found.statuses.push(status);
  check();
});
client.on("fetchAssetResponse", ({ requestId, status, error, data }) => {
  const content = data && Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("base64");
  found.assets[fetch[requestId]] = { status, error, data: content };
  check();
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, reader } = readers.get(subscriptionId);
  if (topic in found.messages) return;
  const bytes = Buffer.from(data.buffer, data.byteOffset, data.byteLength);
  found.messages[topic] = { timestamp: Number(timestamp), data: plain(reader.readMessage(bytes)) };
  found.raw[topic] = bytes.toString("base64");
  check();
});
client.on("close", (event) => {
  console.error(`closed: ${event.code} ${event.reason}`);
  process.exit(1);
});

function check() {
  const all = topics.every((topic) => topic in found.messages) && fetch.every((uri) => uri in found.assets);
  if (!all || (meddle && found.statuses.length < 5)) return;
  clearTimeout(timer);
  process.stdout.write(JSON.stringify(found), () => process.exit(0));
}
