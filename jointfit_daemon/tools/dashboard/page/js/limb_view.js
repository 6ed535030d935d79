// The live limb on a canvas: solid from IMUs, outline from cameras, sensor axes, joint uncertainty.

import { createCamera } from "./camera.js";
import { byId, setText } from "./dom.js";
import { add, conjugate, mix, mixRotations, multiply, norm, rotate, scale, subtract } from "./geometry.js";
import { poseAgeMs, valueOf } from "./store.js";
import { formatNumber, isolate, titleOf } from "./words.js";

const FRAME_MS = 1000 / 30;
const DELAY_MS = 110; // longer than the default period of pose/ui, because the drawing interpolates between two poses
const STALE_MS = 1500;
const SIDE_TURN = -0.6;
const FRONT_TURN = -1.15; // in a view from the side, two legs cover each other
const OPTICAL_MS = 600;
const TURN_STEP = 0.15;
const THICKNESS = [0.15, 0.105];
const AXIS_SHARE = 0.15;
const ASSUMED_M = 0.4; // length of a drawn segment whose length is unknown

/** Draw the limb of a store; return the view, whose `frames` contains the drawing time of each frame, ms. */
export function createLimbView(store) {
  const canvas = byId("limb");
  const view = {
    canvas,
    context: canvas.getContext("2d"),
    camera: createCamera(),
    still: matchMedia("(prefers-reduced-motion: reduce)"),
    colors: readColors(),
    visible: true,
    frames: [],
    last: 0,
    size: [0, 0],
    samples: [],
  };

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { view.colors = readColors(); });
  new ResizeObserver(() => resize(view)).observe(canvas);
  connectTurning(view);
  store.on("pose", () => {
    if (store.pose === null) { view.samples.length = 0; return; }
    view.samples.push({ pose: store.pose, at: store.poseReceivedMs });
    if (view.samples.length > 4) view.samples.shift();
  });

  const step = (now) => {
    requestAnimationFrame(step);
    if (!view.visible || now - view.last < FRAME_MS - 2) return;
    const began = performance.now();
    draw(view, store, now, Math.min(0.2, (now - view.last) / 1000));
    view.last = now;
    view.frames.push(performance.now() - began);
    if (view.frames.length > 900) view.frames.shift();
  };
  requestAnimationFrame(step);
  return view;
}

function readColors() {
  const style = getComputedStyle(document.documentElement);
  const names = ["imu", "imu-light", "imu-dark", "imu-band", "optical", "text", "muted", "surface", "floor", "axis-x", "axis-y", "axis-z"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

function resize(view) {
  const { canvas } = view;
  const ratio = Math.min(2, devicePixelRatio || 1);
  view.size = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = Math.round(canvas.clientWidth * ratio);
  canvas.height = Math.round(canvas.clientHeight * ratio);
  view.context.setTransform(ratio, 0, 0, ratio, 0, 0);
}

// The view turns about the vertical with a pointer or with the arrow keys.
function connectTurning(view) {
  const { canvas, camera } = view;
  let from = null;
  canvas.addEventListener("pointerdown", (event) => {
    from = event.clientX;
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (from === null) return;
    camera.turn -= (event.clientX - from) * 0.012;
    from = event.clientX;
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { from = null; });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: TURN_STEP, ArrowRight: -TURN_STEP }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    camera.turn += step;
  });
}

function draw(view, store, now, seconds) {
  const [width, height] = view.size;
  const { context } = view;
  if (width === 0) return;
  context.clearRect(0, 0, width, height);
  const limb = interpolate(view, store, now);
  if (limb === null) return;

  const points = limb.joints.filter((joint) => joint.p !== null).map((joint) => joint.p);
  if (points.length < 2) return;
  if (store.info.connections && view.camera.turn === null) view.camera.turn = FRONT_TURN;
  view.camera.turn ??= SIDE_TURN;
  const length = lengthOf(limb, store.info);
  if (length === 0) return;
  view.camera.follow(points, length, limb.segments[0]?.q ?? null, seconds, view.still.matches);
  const camera = view.camera.projection(width, height);

  drawFloor(view, camera, points);
  drawSegments(view, camera, limb);
  if (store.optical && now - store.opticalReceivedMs < OPTICAL_MS) drawOptical(view, camera, limb, store.opticals);
  drawJoints(view, camera, limb);
  drawSensors(view, camera, limb, store);
  drawLabels(view, camera, limb, store.info); // drawn last, so no sensor axes cover a name
}

/** Return joints and segments at the drawn time, which is between the last two poses. */
function interpolate(view, store, now) {
  const { samples } = view;
  const info = store.info;
  if (samples.length === 0 || !info) return null;
  const target = now - DELAY_MS;
  let late = samples.findIndex((sample) => sample.at >= target);
  if (late === -1 || view.still.matches) late = samples.length - 1;
  const after = samples[late];
  const before = samples[Math.max(0, late - 1)];
  const span = after.at - before.at;
  const share = span > 0 && !view.still.matches ? Math.min(1, Math.max(0, (target - before.at) / span)) : 1;

  const t_us = before.pose.t_us + (after.pose.t_us - before.pose.t_us) * share;
  const joints = info.joints.map((name) => {
    const [a, b] = [before, after].map((sample) => valueOf(sample.pose.joints, name));
    const p = b?.p_m ? (a?.p_m ? mix(a.p_m, b.p_m, share) : b.p_m) : null;
    return { name, p, sd: b?.sd_m ?? null };
  });
  const segments = info.segments.map((name, i) => {
    const [a, b] = [before, after].map((sample) => valueOf(sample.pose.segments, name));
    const q = b?.q ? (a?.q ? mixRotations(a.q, b.q, share) : b.q) : null;
    const [from, to] = endsOf(info, i).map((end) => joints[end] ?? NO_JOINT);
    if (from.p && q && lacksLength(info, after.pose, i)) to.p = add(from.p, rotate(q, [0, 0, -ASSUMED_M]));
    return { name, q, from, to, used: b?.used ?? [] };
  });
  return { t_us, joints, segments };
}

/** Return whether the orientation of a segment is known but the position of its end is not. */
function lacksLength(info, pose, i) {
  return !info.connections && i + 1 < info.joints.length
    && Boolean(valueOf(pose.segments, info.segments[i])?.q) && !valueOf(pose.joints, info.joints[i + 1])?.p_m;
}

const NO_JOINT = { name: "", p: null, sd: null };

/** Return the numbers of the joints at both ends of a segment; the limb may have two branches. */
function endsOf(info, segment) {
  if (!info.connections) return [segment, segment + 1];
  const name = info.segments[segment];
  const at = (end) => info.joints.flatMap((joint, i) => (valueOf(info.connections, joint)?.[end] === name ? [i] : []));
  const [proximal, distal] = [at("child"), at("parent")];
  return proximal.length > 0 ? [proximal[0], distal[0]] : distal;
}

/** Return the length of the straight limb, along its longer branch. */
function lengthOf(limb, info) {
  const sums = new Map();
  for (const { name, from, to } of limb.segments) {
    if (!from.p || !to.p) continue;
    const proximal = info.joints.find((joint) => valueOf(info.connections, joint)?.child === name);
    const side = valueOf(info.connections, proximal)?.side ?? "";
    sums.set(side, (sums.get(side) ?? 0) + norm(subtract(to.p, from.p)));
  }
  return Math.max(...sums.values(), 0);
}

function drawFloor(view, camera, points) {
  const { context, colors } = view;
  const { target, floor, length, facing } = view.camera;
  const center = [target[0], target[1], floor];
  const f = facing ?? [0, 1, 0];
  const right = [f[1], -f[0], 0];
  context.strokeStyle = colors.floor;
  context.lineWidth = 1;
  context.beginPath();
  for (let i = -3; i <= 3; i += 1) {
    for (const [along, across] of [[f, right], [right, f]]) {
      const middle = add(center, scale(along, i * length * 0.18));
      const a = camera.project(add(middle, scale(across, -0.54 * length)));
      const b = camera.project(add(middle, scale(across, 0.54 * length)));
      context.moveTo(a.x, a.y);
      context.lineTo(b.x, b.y);
    }
  }
  context.stroke();

  // The shadow shows the position of the limb above the floor.
  const lowest = points.reduce((low, p) => (p[2] < low[2] ? p : low));
  const shadow = camera.project([lowest[0], lowest[1], floor]);
  context.fillStyle = colors.floor;
  context.beginPath();
  context.ellipse(shadow.x, shadow.y, camera.pixels * length * 0.14, camera.pixels * length * 0.14 * (camera.sine + 0.12), 0, 0, 7);
  context.fill();
}

function drawSegments(view, camera, limb) {
  const { context, colors } = view;
  const drawn = limb.segments
    .filter((segment) => segment.from.p && segment.to.p)
    .map((segment) => ({ a: camera.project(segment.from.p), b: camera.project(segment.to.p) }))
    .sort((one, other) => other.a.depth + other.b.depth - one.a.depth - one.b.depth);
  for (const { a, b } of drawn) {
    const outline = capsule(a, b, view.camera.length * camera.pixels);
    const { nx, ny, radius } = outline;
    // The light is from the left. The shade across a segment makes it appear round.
    const shade = context.createLinearGradient(a.x + nx * radius, a.y + ny * radius, a.x - nx * radius, a.y - ny * radius);
    const side = nx < 0 ? [0, 1] : [1, 0];
    shade.addColorStop(side[0], colors["imu-light"]);
    shade.addColorStop(0.45, colors.imu);
    shade.addColorStop(side[1], colors["imu-dark"]);
    context.fillStyle = shade;
    context.fill(outline.path);
  }
}

/** Return the outline of a tapered segment between two projected joints. */
function capsule(a, b, limbPixels) {
  const [dx, dy] = [b.x - a.x, b.y - a.y];
  const length = Math.hypot(dx, dy) || 1;
  const [nx, ny] = [-dy / length, dx / length];
  const [ra, rb] = THICKNESS.map((share) => (share * limbPixels) / 2);
  const angle = Math.atan2(dy, dx);
  const path = new Path2D();
  path.arc(a.x, a.y, ra, angle + Math.PI / 2, angle - Math.PI / 2);
  path.arc(b.x, b.y, rb, angle - Math.PI / 2, angle + Math.PI / 2);
  path.closePath();
  return { path, nx, ny, radius: ra };
}

/** Draw the outline of the limb from the cameras at the drawn time. */
function drawOptical(view, camera, limb, frames) {
  const { context, colors } = view;
  context.strokeStyle = colors.optical;
  context.lineWidth = 2.5;
  context.setLineDash([7, 5]);
  for (const segment of limb.segments) {
    const [from, to] = [segment.from.name, segment.to.name].map((name) => opticalPosition(frames, limb.t_us, name));
    if (!from || !to) continue;
    context.stroke(capsule(camera.project(from), camera.project(to), view.camera.length * camera.pixels * 1.12).path);
  }
  context.setLineDash([]);
}

function opticalPosition(frames, t_us, name) {
  const next = frames.findIndex((frame) => frame.t_us >= t_us);
  const after = frames[next === -1 ? frames.length - 1 : next];
  const before = frames[Math.max(0, (next === -1 ? frames.length : next) - 1)];
  const [a, b] = [before, after].map((frame) => valueOf(frame?.joints, name)?.p_m);
  if (!a || !b || after.t_us <= before.t_us) return b ?? null;
  return mix(a, b, Math.min(1, (t_us - before.t_us) / (after.t_us - before.t_us)));
}

function drawJoints(view, camera, limb) {
  const { context, colors } = view;
  for (const joint of limb.joints) {
    if (!joint.p) continue;
    const at = camera.project(joint.p);
    if (joint.sd > 0) {
      context.fillStyle = colors["imu-band"];
      context.strokeStyle = colors.surface;
      context.lineWidth = 1.5;
      context.beginPath();
      context.arc(at.x, at.y, Math.max(4, joint.sd * camera.pixels), 0, 7);
      context.fill();
      context.stroke();
    }
    context.fillStyle = colors.surface;
    context.strokeStyle = colors["imu-dark"];
    context.lineWidth = 2;
    context.beginPath();
    context.arc(at.x, at.y, 4.5, 0, 7);
    context.fill();
    context.stroke();
  }
}

function drawLabels(view, camera, limb, info) {
  view.context.font = "600 13px system-ui, sans-serif";
  view.context.textBaseline = "middle";
  for (const joint of limb.joints) {
    if (!joint.p) continue;
    const at = camera.project(joint.p);
    const side = labelSide(info, joint.name, at.x - view.size[0] / 2);
    drawLabel(view, titleOf(joint.name), at.x, at.y, side * view.camera.length * camera.pixels * 0.13);
  }
}

/** Return the side of a joint on which its name is written: 1 right, -1 left, 0 none. */
function labelSide(info, name, fromMiddle) {
  if (!info.connections) return 1;
  if (valueOf(info.connections, name) === undefined) return 0; // the middle of the root segment
  return fromMiddle < 0 ? -1 : 1;
}

function drawLabel(view, text, jointX, y, offset) {
  const { context, colors } = view;
  if (offset === 0) return;
  const x = jointX + offset;
  context.textAlign = offset < 0 ? "right" : "left";
  context.lineWidth = 4;
  context.strokeStyle = colors.surface;
  context.strokeText(text, x, y);
  context.fillStyle = colors.text;
  context.fillText(text, x, y);
}

/** Draw the axes of every sensor; positions along the segment are schematic. */
function drawSensors(view, camera, limb, store) {
  const { context, colors } = view;
  const mounts = store.calibration?.quality?.sensors;
  const length = view.camera.length * AXIS_SHARE;
  for (const segment of limb.segments) {
    const names = valueOf(store.info.sensors, segment.name) ?? [];
    if (!segment.q || !segment.from.p || !segment.to.p) continue;
    for (const [i, name] of names.entries()) {
      const mount = valueOf(mounts, name)?.q_sensor_segment;
      const origin = mix(segment.from.p, segment.to.p, (i + 1) / (names.length + 1));
      const at = camera.project(origin);
      if (mount) {
        const q = multiply(segment.q, conjugate(mount));
        for (const [axis, color] of [[[1, 0, 0], "axis-x"], [[0, 1, 0], "axis-y"], [[0, 0, 1], "axis-z"]]) {
          const tip = camera.project(add(origin, scale(rotate(q, axis), length)));
          drawAxis(context, at, tip, colors[color], colors.surface);
        }
      }
      const contributes = segment.used.includes(name);
      context.fillStyle = contributes ? colors.text : colors.surface;
      context.strokeStyle = colors.surface;
      context.lineWidth = 1.5;
      context.beginPath();
      context.roundRect(at.x - 7, at.y - 5, 14, 10, 3);
      context.fill();
      context.stroke();
    }
  }
}

function drawAxis(context, from, to, color, halo) {
  for (const [style, width] of [[halo, 5], [color, 3]]) {
    context.strokeStyle = style;
    context.lineWidth = width;
    context.lineCap = "round";
    context.beginPath();
    context.moveTo(from.x, from.y);
    context.lineTo(to.x, to.y);
    context.stroke();
  }
  context.lineCap = "butt";
}

/** Describe the limb as text under the drawing, and mark an outdated drawing. */
export function updateLimbCaption(store) {
  const caption = byId("limb-caption");
  const ageMs = poseAgeMs(store);
  byId("limb-panel").classList.toggle("stale", store.pose !== null && ageMs > STALE_MS);
  byId("legend-optical").hidden = !(store.optical && performance.now() - store.opticalReceivedMs < OPTICAL_MS * 3);
  byId("legend-axes").hidden = !Object.values(store.calibration?.quality?.sensors ?? {}).some((mount) => mount?.q_sensor_segment);
  if (!store.pose) return setText(caption, "No pose was received.");
  if (!store.info) return setText(caption, "The limb cannot be drawn: no message on bridge/info was received.");
  if (ageMs > STALE_MS) return setText(caption, `No pose for ${Math.round(ageMs / 1000)} s: the drawing shows the last pose.`);
  const parts = store.info.segments.map((name) => {
    const segment = valueOf(store.pose.segments, name);
    if (!segment?.q) return `${isolate(titleOf(name))}: unknown`;
    return `${isolate(titleOf(name))} ± ${formatNumber(segment.sd_deg, 1)}° from ${segment.used?.map(isolate).join(", ") || "no sensor"}`;
  });
  const mode = { imu: "First joint fixed (no cameras).", "imu+mocap": "First joint from the cameras." }[store.pose.mode] ?? "";
  const assumed = store.info.segments.filter((_, i) => lacksLength(store.info, store.pose, i)).map((name) => isolate(titleOf(name)));
  const lengths = assumed.length === 0 ? "" : ` Unknown length of ${assumed.join(", ")}: drawn with ${ASSUMED_M} m. Set lengths_m under [chain] in rig.toml.`;
  return setText(caption, `${parts.join(" · ")}. ${mode}${lengths}`);
}
