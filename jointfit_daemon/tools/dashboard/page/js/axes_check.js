// Check of axes, which shows the live axes of every sensor. The user compares them with the housing.

import { createElement, setText } from "./dom.js";
import { conjugate, multiply, rotate } from "./geometry.js";
import { valueOf } from "./store.js";
import { formatNumber } from "./words.js";

const AXES = [["x", [1, 0, 0]], ["y", [0, 1, 0]], ["z", [0, 0, 1]]];
const SIZE = 150;
const STALE_MS = 2000;
const STILL_DEG = 5; // angle below which a sensor counts as not turned

/** Return the panel of the check; it subscribes to `sensors/pose` only while it is shown. */
export function createAxesCheck(store, link) {
  const note = createElement("p", { class: "lead" });
  const drawings = createElement("div", { class: "cards" });
  const cards = new Map();
  const zero = createElement("button", { class: "button", type: "button", onclick: () => { for (const card of cards.values()) card.start = null; update(); } }, "Set all to zero");
  const root = createElement(
    "div", { class: "panel stack" },
    createElement("div", { class: "panel-head" }, createElement("h2", {}, "Check of axes"), zero), note, drawings,
  );
  let visible = false;
  let shownMs = 0;

  const update = () => {
    if (!visible || !isFresh(store)) return;
    updateDrawings(store, drawings, cards);
    updateNote(); // the note is above the drawings, so a later change of its height would move them
  };
  store.on("sensors", update);
  setInterval(() => { if (visible) updateNote(); }, 500);
  const updateNote = () => {
    setText(note, noteOf(store, link, shownMs));
    zero.hidden = !isFresh(store);
  };
  return {
    root,
    show(shown) {
      visible = shown;
      shownMs = performance.now();
      if (shown) link.subscribe("sensors/pose");
      else link.unsubscribe("sensors/pose");
      for (const card of cards.values()) card.start = null;
      updateNote();
      update();
    },
  };
}

function isFresh(store) {
  return store.sensorsReceivedMs !== null && performance.now() - store.sensorsReceivedMs < STALE_MS;
}

function noteOf(store, link, shownMs) {
  if (isFresh(store)) {
    return "Turn one sensor by hand about one of the axes printed on its housing, for example by 90° about x. The drawing must turn the same way, and the line below it must name the same axis, sign and angle. Up in the drawing is up in the room.";
  }
  if (link.state !== "connected" || performance.now() - Math.max(shownMs, link.sinceMs) < STALE_MS) return "Waiting for the orientations of the sensors.";
  return "Orientations of single sensors are not published. To see their axes, set sensors_hz = 10 under [mqtt] in rig.toml and reload the daemon.";
}

function updateDrawings(store, drawings, cards) {
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(`--${name}`).trim();
  for (const [name, sensor] of Object.entries(store.sensors?.sensors ?? {})) {
    if (!cards.has(name)) {
      cards.set(name, createCard(name));
      drawings.append(cards.get(name).root);
    }
    const card = cards.get(name);
    const world = valueOf(store.calibration?.quality?.sensors, name)?.q_optical_world;
    drawAxes(card.canvas, sensor.q && world ? multiply(world, sensor.q) : sensor.q, color);
    if (sensor.q) card.start ??= sensor.q;
    const turn = sensor.q ? turnSince(card.start, sensor.q) : null;
    setText(card.turn, turn === null ? "no data" : turnText(turn));
    card.root.classList.toggle("turned", turn !== null && turn.angle >= STILL_DEG);
  }
}

function createCard(name) {
  const canvas = createElement("canvas", { width: SIZE * 2, height: SIZE * 2, role: "img", "aria-label": `Axes of ${name}`, class: "axes" });
  const turn = createElement("p", { class: "digits turn" });
  return { canvas, turn, start: null, root: createElement("article", { class: "card" }, createElement("h3", { dir: "auto" }, name), canvas, turn) };
}

/** Return the rotation between two orientations: its angle, the nearest sensor axis, and the angle between this axis and the axis of rotation, degrees. */
export function turnSince(start, q) {
  const [w, ...v] = multiply(conjugate(start), q); // in the axes of the sensor
  const sign = w < 0 ? -1 : 1;
  const angle = (2 * Math.atan2(Math.hypot(...v), Math.abs(w)) * 180) / Math.PI;
  const largest = v.reduce((best, value, i) => (Math.abs(value) > Math.abs(v[best]) ? i : best), 0);
  const across = Math.hypot(...v.filter((_, i) => i !== largest));
  const tilt = (Math.atan2(across, Math.abs(v[largest])) * 180) / Math.PI;
  return { angle, axis: `${sign * v[largest] < 0 ? "−" : "+"}${"xyz"[largest]}`, tilt };
}

function turnText({ angle, axis, tilt }) {
  if (angle < STILL_DEG) return "not turned";
  const degrees = formatNumber(angle, 0, "°");
  return tilt > 30 ? `turned ${degrees}, between the axes` : `turned ${degrees} about ${axis}`;
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
  // The view is along y, slightly from above and from the right.
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
