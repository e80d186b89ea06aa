// Print poses in Node.js. Once, in this folder: npm install mqtt
//
//     node subscribe.mjs mqtt://127.0.0.1:1883 10
//
// A third argument of 5 asks for MQTT 5, which tells content types; brokers of 3.1.1, such as the embedded one,
// do not speak it. ws://127.0.0.1:9001 works too, where the broker listens for WebSockets.

import mqtt from "mqtt";

const [url = "mqtt://127.0.0.1:1883", count = "0", version = "4"] = process.argv.slice(2); // 4 is MQTT 3.1.1
const client = mqtt.connect(url, { protocolVersion: Number(version) });
let left = Number(count) || Infinity;

client.on("connect", () => client.subscribe("mocap/+/pose"));
client.on("error", (error) => {
  console.error(`${url}: ${error.message}`);
  process.exit(1);
});
client.on("message", (topic, payload, packet) => {
  if (left === 0) return; // what came together with the last one
  const pose = JSON.parse(payload);
  const type = packet.properties?.contentType ?? "no content type";
  console.log(topic, type, pose.seq, pose.root, JSON.stringify(pose.segments[pose.root]));
  left -= 1;
  if (left === 0) client.end();
});
