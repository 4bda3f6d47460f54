// Connects with @foxglove/ws-protocol, subscribes to all topics, and prints each event as a line of JSON.
// Usage: node foxglove_client.mjs FOLDER_WITH_NODE_MODULES ADDRESS SUBPROTOCOL MESSAGES [ORIGIN]
import { createRequire } from "node:module";

const [home, address, subprotocol, count, origin] = process.argv.slice(2);
const require = createRequire(home + "/");
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const WebSocket = require("ws");

const say = (row) => console.log(JSON.stringify(row));
const client = new FoxgloveClient({ ws: new WebSocket(address, [subprotocol], origin ? { origin } : {}) });
const topics = new Map();
let left = Number(count);
client.on("error", (error) => say({ error: error.message }));
client.on("close", () => process.exit(1));
client.on("serverInfo", (info) => say({ info }));
client.on("time", (event) => say({ time: String(event.timestamp) }));
client.on("advertise", (channels) => {
  for (const channel of channels) {
    topics.set(client.subscribe(channel.id), channel.topic);
    say({ channel });
  }
});
client.on("message", (event) => {
  const data = Buffer.from(event.data.buffer, event.data.byteOffset, event.data.byteLength);
  const row = { topic: topics.get(event.subscriptionId), time: String(event.timestamp) };
  say({ message: { ...row, data: data.toString("base64") } });
  left -= 1;
  if (left === 0) process.exit(0);
});
