// Check of axes: the live axes of every sensor, to be compared with the housing in the hand.

import { createElement, setText } from "./dom.js";
import { multiply, rotate } from "./geometry.js";
import { valueOf } from "./store.js";

const AXES = [["x", [1, 0, 0]], ["y", [0, 1, 0]], ["z", [0, 0, 1]]];
const SIZE = 150;
const STALE_MS = 2000;

/** Return the panel of the check; it subscribes to `sensors/pose` only while it is shown. */
export function createAxesCheck(store, link) {
  const note = createElement("p", { class: "lead" });
  const drawings = createElement("div", { class: "cards" });
  const root = createElement("div", { class: "panel stack" }, createElement("h2", {}, "Check of axes"), note, drawings);
  const canvases = new Map();
  let visible = false;

  const update = () => { if (visible) updateDrawings(store, drawings, canvases); };
  store.on("sensors", update);
  setInterval(() => { if (visible) setText(note, noteOf(store)); }, 500);
  return {
    root,
    show(shown) {
      visible = shown;
      if (shown) link.subscribe("sensors/pose");
      else link.unsubscribe("sensors/pose");
      setText(note, noteOf(store));
      update();
    },
  };
}

function noteOf(store) {
  const fresh = store.sensorsReceivedMs !== null && performance.now() - store.sensorsReceivedMs < STALE_MS;
  if (fresh) {
    return "Turn one sensor by hand. Its axes must turn the same way here as on its housing: x, y and z as printed there, z of the world up.";
  }
  return "Orientations of single sensors are not published. To see their axes, set sensors_hz = 10 under [mqtt] in rig.toml and reload the daemon.";
}

function updateDrawings(store, drawings, canvases) {
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(`--${name}`).trim();
  for (const [name, sensor] of Object.entries(store.sensors?.sensors ?? {})) {
    if (!canvases.has(name)) {
      const canvas = createElement("canvas", { width: SIZE * 2, height: SIZE * 2, role: "img", "aria-label": `Axes of ${name}`, class: "axes" });
      canvases.set(name, canvas);
      drawings.append(createElement("article", { class: "card" }, createElement("h3", { dir: "auto" }, name), canvas));
    }
    const world = valueOf(store.calibration?.quality?.sensors, name)?.q_optical_world;
    drawAxes(canvases.get(name), sensor.q && world ? multiply(world, sensor.q) : sensor.q, color);
  }
}

function drawAxes(canvas, q, color) {
  const context = canvas.getContext("2d");
  const middle = SIZE;
  context.clearRect(0, 0, 2 * SIZE, 2 * SIZE);
  context.font = "600 24px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  if (!q) {
    context.fillStyle = color("muted");
    context.fillText("no data", middle, middle);
    return;
  }
  // The viewer looks along y, a little from above and from the right.
  const project = ([x, y, z]) => [middle + 100 * (0.9 * x + 0.42 * y), middle - 100 * (0.92 * z + 0.25 * y - 0.12 * x)];
  for (const [name, axis] of AXES) {
    const tip = rotate(q, axis);
    const [x, y] = project(tip);
    context.strokeStyle = color(`axis-${name}`);
    context.fillStyle = color(`axis-${name}`);
    context.lineWidth = 7;
    context.lineCap = "round";
    context.beginPath();
    context.moveTo(middle, middle);
    context.lineTo(x, y);
    context.stroke();
    const [labelX, labelY] = project(tip.map((value) => value * 1.25));
    context.fillText(name, labelX, labelY);
  }
}
