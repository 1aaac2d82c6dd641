// Reads an MCAP file with @mcap/core, every checksum on, in file order and in log order. Prints one JSON object:
// {messages: {topic: count}, backwards, findings: [text]}.
const fs = require("node:fs");
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");

async function main(path) {
  const data = fs.readFileSync(path);
  const findings = [];
  const streamed = {};
  const topics = new Map();
  try {
    const reader = new McapStreamReader({ validateCrcs: true });
    reader.append(data);
    for (let record; (record = reader.nextRecord()); ) {
      if (record.type === "Channel") topics.set(record.id, record.topic);
      if (record.type === "Message") {
        const topic = topics.get(record.channelId);
        streamed[topic] = (streamed[topic] ?? 0) + 1;
      }
    }
    if (!reader.done()) findings.push("the file does not end where its last record does");
  } catch (error) {
    findings.push(`in file order: ${error.message}`);
  }
  const indexed = {};
  let last = 0n;
  let backwards = 0;
  try {
    const readable = {
      size: async () => BigInt(data.length),
      read: async (offset, size) => new Uint8Array(data.subarray(Number(offset), Number(offset + size))),
    };
    const reader = await McapIndexedReader.Initialize({ readable });
    for await (const message of reader.readMessages({ validateCrcs: true })) {
      const topic = reader.channelsById.get(message.channelId).topic;
      indexed[topic] = (indexed[topic] ?? 0) + 1;
      if (message.logTime < last) backwards += 1;
      last = message.logTime;
    }
    const sorted = (counts) => JSON.stringify(Object.entries(counts).sort());
    if (sorted(indexed) !== sorted(streamed)) findings.push("the index leads to other messages than the file has");
    if (Number(reader.statistics.messageCount) !== Object.values(indexed).reduce((a, b) => a + b, 0))
      findings.push("the statistics count other messages than the file has");
    // Lichtblick takes a recording's beginning and end from here.
    const starts = reader.chunkIndexes.map((chunk) => chunk.messageStartTime);
    const ends = reader.chunkIndexes.map((chunk) => chunk.messageEndTime);
    const { messageStartTime, messageEndTime } = reader.statistics;
    if (starts.some((time) => time < messageStartTime) || ends.some((time) => time > messageEndTime))
      findings.push("a chunk reaches beyond the first or last message");
  } catch (error) {
    findings.push(`in log order: ${error.message}`);
  }
  console.log(JSON.stringify({ messages: indexed, backwards, findings }));
}

main(process.argv[2]);
