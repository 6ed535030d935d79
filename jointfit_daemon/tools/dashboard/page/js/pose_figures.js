// Drawings of the calibration poses: stick figures from the side or from the front, as SVG.

import { createElement, createSvg } from "./dom.js";

// Joints in a box of 100 by 130; the ground is at y = 124. "limb" is the part of the body with the sensors.
// "words" are words in the daemon's remedies for which the figure shows the right movement.
const FIGURES = {
  plate: {
    label: "Turn about three axes",
    draw: () => [
      createSvg("rect", { class: "plate", x: 16, y: 46, width: 68, height: 38, rx: 5, transform: "rotate(-14 50 65)" }),
      ...[[29, 70], [43, 67], [57, 63], [71, 60]].map(([x, y]) => sensor(x, y, -14)),
      ...[[22, 57], [76, 44], [24, 88], [80, 74]].map(([cx, cy]) => createSvg("circle", { class: "marker", cx, cy, r: 3 })),
      arrow("M22 32 A34 16 -14 0 1 76 20"), arrow("M92 44 A16 30 0 0 1 90 88"), arrow("M70 104 A34 14 -10 0 1 18 106"),
    ],
  },
  stand: {
    label: "Upright and still", head: [50, 14],
    body: ["50,25 50,66", "50,30 43,48 42,66", "50,30 57,48 58,66", "49,66 45,94 45,119 38,119"],
    limb: "51,66 56,94 56,119 63,119", sensors: [[53, 76], [55, 87], [56, 101], [56, 111]],
  },
  walk: {
    label: "Walk", words: /walk/, head: [52, 14],
    body: ["51,25 49,66", "51,31 40,46 35,60", "51,31 60,47 71,54", "49,66 41,92 25,108 19,104"],
    limb: "50,66 63,92 67,119 76,117", sensors: [[55, 76], [60, 86], [65, 100], [66, 110]],
    draw: () => [arrow("M76 22 L94 22")],
  },
  squat: {
    label: "Squat", words: /squat/, head: [57, 36],
    body: ["54,46 40,82", "52,52 68,60 84,60"],
    limb: "40,82 68,90 56,119 66,119", sensors: [[49, 84.5], [59, 87.5], [64.5, 99], [60, 110]],
    draw: () => [arrow("M16 44 L16 84")],
  },
  sit: {
    label: "Sit, stand up", words: /sit down/, head: [41, 30],
    body: ["40,41 36,80", "40,48 53,64 64,70"], seat: "22,119 22,86 48,86",
    limb: "37,80 66,80 66,119 76,119", sensors: [[47, 80], [57, 80], [66, 93], [66, 106]],
    draw: () => [arrow("M88 84 L88 44")],
  },
  circle: {
    label: "Circle the leg", words: /sideways|circle it|swing the leg/, head: [45, 14],
    body: ["45,25 45,66", "45,30 36,42 28,50", "45,30 55,43 62,52", "45,66 42,94 42,119 35,119"],
    limb: "46,66 64,86 75,106 83,102", sensors: [[52, 73], [59, 80.5], [68, 93.5], [72, 101]],
    draw: () => [arrow("M64 117 A19 8 -16 1 0 92 102")],
  },
  foot: {
    label: "Bend the foot", words: /foot/, head: [41, 14],
    body: ["41,25 41,66", "41,30 32,42 24,50", "41,30 50,43 58,52", "41,66 39,94 39,119 32,119"],
    limb: "42,66 60,80 62,104 73,100", sensors: [[48, 70.5], [55, 76], [61, 87], [61.6, 97]],
    draw: () => [arrow("M86 110 A16 16 0 0 0 84 88")],
  },
  upright: {
    label: "Upright and still", head: [50, 14],
    body: ["50,60 45,92 45,119 38,119", "50,60 55,92 55,119 62,119", "50,30 42,46 41,64"],
    limb: "50,25 50,58", more: "50,30 59,46 60,64", sensors: [[50, 36], [50, 50], [55.5, 40], [59.6, 56]],
  },
  swing: {
    label: "Swing the arm", words: /swing|forward/, head: [44, 14],
    body: ["44,25 44,66", "44,66 40,94 40,119 47,119", "44,66 48,94 48,119 55,119"],
    limb: "44,30 62,40 78,34", sensors: [[51, 34], [57, 37], [66, 38.5], [73, 36]],
    draw: () => [arrow("M70 52 A30 30 0 0 0 72 16"), arrow("M30 66 A30 30 0 0 1 20 46")],
  },
  bend: {
    label: "Bend and turn", words: /bend|turn/, head: [42, 14],
    body: ["42,25 42,66", "42,66 38,94 38,119 45,119", "42,66 46,94 46,119 53,119"],
    limb: "42,30 46,54 66,42", sensors: [[43.5, 39], [45, 48], [52, 50.4], [59, 46.2]],
    draw: () => [arrow("M74 58 A26 26 0 0 0 68 24")],
  },
  hand: {
    label: "Circle the hand", words: /hand|wrist|raise|sideways/, head: [42, 14],
    body: ["42,25 42,66", "42,66 38,94 38,119 45,119", "42,66 46,94 46,119 53,119"],
    limb: "42,30 58,46 76,46 84,46", sensors: [[48, 36], [54, 42], [63, 46], [71, 46]],
    draw: () => [arrow("M84 34 A9 13 0 1 1 76 58")],
  },
  bow: {
    label: "Bend forward", words: /forward|nod|bend/, head: [80, 40],
    body: ["42,68 40,94 40,119 47,119", "42,68 48,94 48,119 55,119", "62,48 66,66 68,78"],
    limb: "42,68 52,54 70,44", sensors: [[46, 62], [51, 55.4], [58, 50.8], [65, 47]],
    draw: () => [arrow("M50 16 A40 40 0 0 1 84 24")],
  },
  side: {
    label: "Turn and bend sideways", words: /side|turn|twist/, head: [66, 20],
    body: ["48,68 42,94 42,119 36,119", "48,68 54,94 54,119 60,119", "60,36 76,48 78,62", "58,38 42,46 34,58"],
    limb: "48,68 51,50 61,31", sensors: [[48.8, 62], [50.5, 53], [54, 45], [58, 37]],
    draw: () => [arrow("M38 18 A30 30 0 0 1 52 8"), arrow("M82 14 A28 28 0 0 1 92 30")],
  },
};

/** Return the drawings with these names, and a function that marks the drawings that fit a remedy. */
export function createFigures(names) {
  const figures = names.map((name) => ({ ...FIGURES[name], root: drawFigure(FIGURES[name]) }));
  const root = createElement("div", { class: `figures n${figures.length}` }, ...figures.map((figure) => figure.root));
  const highlight = (remedy) => {
    const fits = figures.map(({ words }) => remedy !== "" && words?.test(remedy));
    const any = fits.includes(true);
    figures.forEach((figure, i) => {
      figure.root.classList.toggle("wanted", fits[i]);
      figure.root.classList.toggle("other", any && !fits[i]);
    });
  };
  return { root, highlight };
}

function drawFigure(figure) {
  const parts = [];
  if (figure.head) {
    parts.push(createSvg("line", { class: "ground", x1: 4, y1: 124, x2: 96, y2: 124 }));
    if (figure.seat) parts.push(createSvg("polyline", { class: "seat", points: figure.seat }));
    parts.push(...figure.body.map((points) => createSvg("polyline", { class: "body", points })));
    parts.push(createSvg("circle", { class: "head", cx: figure.head[0], cy: figure.head[1], r: 9 }));
    for (const points of [figure.limb, figure.more]) if (points) parts.push(createSvg("polyline", { class: "limb-line", points }));
    parts.push(...figure.sensors.map(([x, y]) => sensor(x, y)));
  }
  parts.push(...(figure.draw?.() ?? []));
  return createElement(
    "figure", { class: "pose" },
    createSvg("svg", { class: "figure", viewBox: "0 0 100 130", "aria-hidden": "true" }, ...parts),
    createElement("figcaption", {}, figure.label),
  );
}

const sensor = (x, y, turn = 0) => createSvg("rect", { class: "sensor", x: x - 3.5, y: y - 3.5, width: 7, height: 7, rx: 2, transform: `rotate(${turn} ${x} ${y})` });

/** Return an arrow along a path; the last two numbers of the path are the tip of the arrow. */
function arrow(path) {
  const group = createSvg("g", { class: "motion" }, createSvg("path", { d: path }));
  const numbers = path.match(/-?[\d.]+/g).map(Number);
  const [x, y] = numbers.slice(-2);
  const direction = endDirection(group.firstChild, x, y);
  const side = (turn) => [x - 8 * Math.cos(direction + turn), y - 8 * Math.sin(direction + turn)];
  const [a, b] = [side(0.6), side(-0.6)];
  group.append(createSvg("polyline", { points: `${a.join()} ${x},${y} ${b.join()}` }));
  return group;
}

/** Return the direction of the last part of a path, which the head of the arrow covers. */
function endDirection(path, x, y) {
  const before = path.getPointAtLength(Math.max(0, path.getTotalLength() - 5));
  return Math.atan2(y - before.y, x - before.x);
}
