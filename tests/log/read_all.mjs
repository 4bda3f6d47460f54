// Reads a log whole with @mcap/core. Prints: messages by index, CRC-32 of their payloads in log order,
// messages by streaming (-1 where that fails). Usage: node read_all.mjs FOLDER_WITH_NODE_MODULES FILE
import { createRequire } from "node:module";
import { open, readFile } from "node:fs/promises";

const require = createRequire(process.argv[2] + "/");
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");
const zlib = require("node:zlib");

const table = new Uint32Array(256).map((_, n) => {
  let c = n;
  for (let k = 0; k < 8; k++) c = c & 1 ? (c >>> 1) ^ 0xedb88320 : c >>> 1;
  return c >>> 0;
});
function crc32(data, crc) {
  if (zlib.crc32) return zlib.crc32(data, crc);
  let c = ~crc;
  for (const byte of data) c = table[(c ^ byte) & 255] ^ (c >>> 8);
  return ~c >>> 0;
}

const file = await open(process.argv[3]);
const decompressHandlers = await loadDecompressHandlers();
const reader = await McapIndexedReader.Initialize({
  decompressHandlers,
  readable: {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, length) => {
      const buffer = new Uint8Array(Number(length));
      const { bytesRead } = await file.read(buffer, 0, Number(length), Number(offset));
      if (bytesRead !== Number(length)) throw new Error(`short read at ${offset}`);
      return buffer;
    },
  },
});
let count = 0;
let crc = 0;
for await (const message of reader.readMessages()) {
  count += 1;
  crc = crc32(message.data, crc);
}
await file.close();

function countStreamed(data) {
  const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  stream.append(data);
  let streamed = 0;
  for (let record; (record = stream.nextRecord()); ) if (record.type === "Message") streamed += 1;
  if (!stream.done()) throw new Error("the stream ended early");
  return streamed;
}

let streamed = -1;
try {
  streamed = countStreamed(await readFile(process.argv[3]));
} catch (error) {
  console.error(error.message);
}
console.log(count, crc, streamed);
