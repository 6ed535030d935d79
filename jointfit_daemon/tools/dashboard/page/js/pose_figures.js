// Drawings of the calibration poses: stick figures from the side or from the front, as SVG.

import { createSvg } from "./dom.js";

// Joints in a box of 100 by 130; the ground is at y = 122. "leg" carries the sensors.
const FIGURES = {
  plate: {
    label: "All sensors on one plate, turned about three axes",
    extra: () => [
      createSvg("rect", { class: "plate", x: 18, y: 52, width: 64, height: 34, rx: 4, transform: "rotate(-14 50 69)" }),
      ...[[32, 70], [44, 67], [56, 64], [68, 61]].map(([x, y]) => createSvg("rect", { class: "sensor", x: x - 5, y: y - 4, width: 10, height: 8, rx: 2, transform: `rotate(-14 ${x} ${y})` })),
      arrow("M22 40 A34 16 -14 0 1 76 28"), arrow("M88 54 A16 30 0 0 1 86 98"), arrow("M66 108 A34 14 -10 0 1 16 104"),
    ],
  },
  stand: {
    label: "Stand upright and still, joints straight",
    head: [50, 16], body: ["50,26 50,66", "50,32 42,64", "50,32 58,64", "50,66 44,94 44,120 38,120"],
    leg: "50,66 56,94 56,120 63,120", sensors: [[53, 75], [56, 87], [57, 101], [57, 113]],
  },
  walk: {
    label: "Walk",
    head: [52, 16], body: ["52,26 50,66", "51,32 38,46 34,60", "51,32 62,46 72,54", "50,66 40,92 24,110 18,106"],
    leg: "50,66 64,92 68,120 77,120", sensors: [[55, 74], [61, 86], [65, 100], [67, 112]],
    extra: () => [arrow("M76 26 L92 26")],
  },
  squat: {
    label: "Squat",
    head: [58, 38], body: ["55,48 40,82", "54,54 68,62 84,62", "40,82 64,88 50,120 58,120"],
    leg: "40,82 68,92 56,120 66,120", sensors: [[47, 85], [59, 89], [65, 100], [60, 111]],
    extra: () => [arrow("M18 48 L18 84")],
  },
  sit: {
    label: "Sit down and stand up",
    head: [40, 32], body: ["40,42 36,82", "40,50 54,66 64,72", "24,84 24,120", "16,84 46,84"],
    leg: "36,80 66,80 66,120 76,120", sensors: [[45, 80], [57, 80], [66, 94], [66, 108]],
    extra: () => [arrow("M84 84 L84 46")],
  },
  circle: {
    label: "Circle the hip: lift the leg and draw circles with the foot",
    head: [46, 16], body: ["46,26 46,66", "46,32 30,52", "46,32 62,52", "46,66 42,94 42,120 36,120"],
    leg: "46,66 66,88 76,110 84,106", sensors: [[52, 73], [60, 82], [69, 95], [73, 104]],
    extra: () => [arrow("M60 116 A20 9 -18 1 0 92 100")],
  },
  move: {
    label: "Move every joint of the limb through its whole range",
    head: [40, 18], body: ["40,28 40,74", "40,74 34,98 34,120 28,120", "40,74 48,98 48,120 56,120", "40,34 28,56 24,70"],
    leg: "40,34 60,48 78,34", sensors: [[47, 39], [54, 44], [66, 43], [72, 39]],
    extra: () => [arrow("M86 50 A24 24 0 0 1 64 66"), arrow("M84 22 A22 22 0 0 0 66 12")],
  },
};

const FUNCTIONAL = { leg: ["walk", "squat", "sit", "circle"], other: ["move"] };

/** Return the drawings of a phase for a limb. */
export function figuresOfPhase(phase, joints) {
  const isLeg = joints.some((name) => /knee|hip|ankle/.test(name));
  const names = { align: ["plate"], static: ["stand"], functional: FUNCTIONAL[isLeg ? "leg" : "other"] }[phase];
  return names.map(drawFigure);
}

function drawFigure(name) {
  const figure = FIGURES[name];
  const parts = [createSvg("title", {}, figure.label)];
  if (figure.head) {
    parts.push(createSvg("line", { class: "ground", x1: 4, y1: 124, x2: 96, y2: 124 }));
    parts.push(...figure.body.map((points) => createSvg("polyline", { class: "body", points })));
    parts.push(createSvg("circle", { class: "head", cx: figure.head[0], cy: figure.head[1], r: 9 }));
    parts.push(createSvg("polyline", { class: "leg", points: figure.leg }));
    parts.push(...figure.sensors.map(([x, y]) => createSvg("rect", { class: "sensor", x: x - 4, y: y - 4, width: 8, height: 8, rx: 2.5 })));
  }
  parts.push(...(figure.extra?.() ?? []).flat());
  return createSvg("svg", { class: "figure", viewBox: "0 0 100 130", role: "img" }, ...parts);
}

/** Return a path with a head at its end; the head follows from the last two numbers of the path. */
function arrow(path) {
  const group = createSvg("g", { class: "motion" }, createSvg("path", { d: path }));
  const numbers = path.match(/-?[\d.]+/g).map(Number);
  const [x, y] = numbers.slice(-2);
  const direction = arrowDirection(path, numbers, x, y);
  const side = (turn) => [x - 8 * Math.cos(direction + turn), y - 8 * Math.sin(direction + turn)];
  const [a, b] = [side(0.6), side(-0.6)];
  group.append(createSvg("polyline", { points: `${a.join()} ${x},${y} ${b.join()}` }));
  return group;
}

// A straight arrow points along its line; an arc ends perpendicular to the chord's bulge, about 50°
// from the chord.
function arrowDirection(path, numbers, x, y) {
  const chord = Math.atan2(y - numbers[1], x - numbers[0]);
  if (!path.includes("A")) return chord;
  const sweep = numbers[numbers.length - 3];
  return chord + (sweep === 1 ? 0.85 : -0.85);
}
