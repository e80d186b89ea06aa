// mqtt.js for browsers, from this folder: nothing is loaded from elsewhere.
import mqtt from "./node_modules/mqtt/dist/mqtt.esm.js";

const STALE_MS = 1000;
const broker = new URLSearchParams(location.search).get("broker") ?? "ws://127.0.0.1:9001";
const state = document.getElementById("state");
const rate = document.getElementById("rate");
const rows = new Map();
let received = 0;
let newestAt = 0;
let pose = null;

const client = mqtt.connect(broker);
client.on("connect", () => client.subscribe(["mocap/+/bridge/state", "mocap/+/pose"]));
client.on("close", () => { state.textContent = `no broker at ${broker}`; });
client.on("message", (topic, payload) => {
  const message = JSON.parse(new TextDecoder().decode(payload));
  if (topic.endsWith("/bridge/state")) {
    state.textContent = `${topic.split("/")[1]}: ${message.state}`;
    return;
  }
  pose = message;
  received += 1;
  newestAt = performance.now();
});

// Drawn as often as the screen is, however often poses come.
function draw() {
  requestAnimationFrame(draw);
  document.body.classList.toggle("stale", newestAt > 0 && performance.now() - newestAt > STALE_MS);
  if (pose === null) return;
  for (const [name, q] of Object.entries(pose.segments)) {
    const row = rows.get(name) ?? newRow(name);
    row.values.textContent = q === null ? "–" : q.map((value) => value.toFixed(3)).join(", ");
    row.status.textContent = pose.status[name];
    row.status.className = pose.status[name];
  }
  pose = null;
}

function newRow(name) {
  const line = document.getElementById("segments").insertRow();
  line.insertCell().textContent = name;
  const row = { values: line.insertCell(), status: line.insertCell() };
  rows.set(name, row);
  return row;
}

setInterval(() => {
  rate.textContent = `${received} poses a second`;
  received = 0;
}, 1000);
draw();
