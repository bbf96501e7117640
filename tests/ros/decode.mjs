// Decodes messages of ROS 2 by @foxglove/rosmsg2-serialization: one JSON line in, one out.
import readline from "node:readline";
import { createRequire } from "node:module";

const require = createRequire(`${process.argv[2]}/x.js`);
const { parse } = require("@foxglove/rosmsg");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");

const plain = (_, value) =>
  typeof value === "bigint" ? Number(value) : ArrayBuffer.isView(value) ? Array.from(value, Number) : value;
for await (const line of readline.createInterface({ input: process.stdin })) {
  const { definition, hex } = JSON.parse(line);
  const reader = new MessageReader(parse(definition, { ros2: true }));
  console.log(JSON.stringify(reader.readMessage(Buffer.from(hex, "hex")), plain));
}
