// Reads a recording with the npm package and prints what is in it, as JSON.
//     node read_with_npm.mjs FILE      (PACKAGES names the directory that holds node_modules)
import { createHash } from "node:crypto";
import { open } from "node:fs/promises";
import { createRequire } from "node:module";

const require = createRequire(`${process.env.PACKAGES}/`);
const { McapIndexedReader } = require("@mcap/core");
const { decompress } = require("fzstd");

const file = await open(process.argv[2]);
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    await file.read(buffer, 0, buffer.length, Number(offset));
    return buffer;
  },
};
const decompressHandlers = {
  zstd: (data, size) => decompress(data, new Uint8Array(Number(size))),
};
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const topics = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  const found = (topics[channel.topic] ??= { schema: schema.name, count: 0, hash: createHash("sha256") });
  found.count += 1;
  found.hash.update(message.data);
}
for (const found of Object.values(topics)) found.hash = found.hash.digest("hex");
const attachments = {};
for await (const { name, data } of reader.readAttachments()) {
  attachments[name] = new TextDecoder().decode(data);
}
const metadata = {};
for await (const { name, metadata: found } of reader.readMetadata()) {
  metadata[name] = Object.fromEntries(found);
}
console.log(JSON.stringify({ topics, attachments, metadata }));
await file.close();
