// The chosen angle: large number, standard deviation, and the curve of the last 20 s.

import { byId, createElement, setClass, setText } from "./dom.js";
import { poseAgeMs, shownSeconds, valueOf } from "./store.js";
import { UNKNOWN, angleName, flagSentence, formatNumber, isMinorFlag, isolate, titleOf } from "./words.js";

const NUMBER_MS = 200;
const STALE_MS = 1500;
const OPTICAL_GAP_US = 150_000;
const GAP_PERIODS = 3.5; // longest pause, in periods of the poses, that does not interrupt the curve
const MARK = { dash: [4, 4], font: "600 12px system-ui, sans-serif" };
const HAS_SD = /^(flexion|elevation|inner)_deg$/;
const STORED_CHOICE = "jointfit-angle";

/** Show the angle of a store; return the view. */
export function createAngleView(store) {
  const view = { store, choice: null, choices: "", chart: null, lastNumber: 0, visible: true, frames: [] };
  const select = byId("angle-choice");
  select.addEventListener("change", () => {
    view.choice = JSON.parse(select.value);
    sessionStorage.setItem(STORED_CHOICE, select.value);
    update(view, true);
  });

  const rebuild = () => { view.chart?.destroy(); view.chart = null; update(view, true); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", rebuild);
  new ResizeObserver(([entry]) => {
    const { width, height } = entry.contentRect;
    if (view.chart && width > 0) view.chart.setSize({ width, height });
    else if (width > 0) update(view, true);
  }).observe(byId("chart"));

  store.on("pose", () => update(view, false));
  store.on("info", () => { view.choices = ""; });
  return view;
}

function update(view, atOnce) {
  const { store } = view;
  if (!store.pose || !view.visible) return;
  const began = performance.now();
  updateChoices(view);
  if (view.choice === null) {
    setText(byId("angle-reason"), noAngleReason(store));
    return;
  }
  // A new theme or size redraws the panel. An old number must not appear again.
  if (poseAgeMs(store) < STALE_MS && (atOnce || began - view.lastNumber >= NUMBER_MS)) {
    view.lastNumber = began;
    updateNumber(view);
  }
  updateChart(view);
  view.frames.push(performance.now() - began);
  if (view.frames.length > 900) view.frames.shift();
}

/** Return the keys of the angles that a joint has. */
export function angleKeys(joint) {
  return Object.keys(joint).filter((key) => key.endsWith("_deg") && key !== "sd_deg");
}

function updateChoices(view) {
  const { info, pose } = view.store;
  const names = info?.joints ?? Object.keys(pose.joints);
  const options = names.flatMap((name) => {
    const joint = valueOf(pose.joints, name);
    return joint ? angleKeys(joint).map((key) => [name, key]) : [];
  });
  const wanted = JSON.stringify(options);
  if (wanted === view.choices || options.length === 0) return;

  view.choices = wanted;
  const select = byId("angle-choice");
  select.replaceChildren(...options.map(([name, key]) =>
    createElement("option", { value: JSON.stringify([name, key]) }, `${isolate(titleOf(name))} · ${angleName(key)}`)));
  const stored = sessionStorage.getItem(STORED_CHOICE);
  const known = options.some((option) => JSON.stringify(option) === stored);
  select.value = known ? stored : JSON.stringify(options[0]);
  view.choice = JSON.parse(select.value);
}

/** Return the chosen joint and angle as text, such as "Knee flexion". */
export function chosenTitle(view) {
  return view.choice === null ? "Joint angle" : `${isolate(titleOf(view.choice[0]))} ${angleName(view.choice[1])}`;
}

/** Return the current value and standard deviation of the chosen angle; null if unknown. */
export function chosenValue(view) {
  const pose = view.store.pose;
  if (!pose || view.choice === null) return [null, null];
  const [name, key] = view.choice;
  const joint = valueOf(pose.joints, name) ?? {};
  return [joint[key] ?? null, sdOf(joint, key)];
}

// sd_deg is the standard deviation of the flexion, or of the elevation of a shoulder.
function sdOf(joint, key) {
  return HAS_SD.test(key) ? joint.sd_deg ?? null : null;
}

function updateNumber(view) {
  const [value, sd] = chosenValue(view);
  setText(byId("angle-title"), chosenTitle(view));
  setText(byId("angle-value"), value === null ? UNKNOWN : formatNumber(value, 1, "°"));
  setText(byId("angle-sd"), value !== null && sd !== null ? `± ${formatNumber(sd, 1, "°")}` : "");
  const [reason, level] = reasonOf(view, value, sd);
  setText(byId("angle-reason"), reason);
  setClass(byId("angle-reason"), `reason ${level}`);
}

/** Return the most important limitation of the angle as text, and its level. */
function reasonOf(view, value, sd) {
  const flags = view.store.pose.flags ?? [];
  const serious = flags.filter((flag) => !isMinorFlag(flag));
  if (serious.length > 0) return [serious.map(flagSentence).slice(0, 2).join(" "), "warning"];
  if (value === null) return ["The angle is unknown: one of its two segments has no orientation.", "warning"];
  if (sd === null && HAS_SD.test(view.choice[1])) return ["The standard deviation is unknown.", ""];
  if (sd === null) return ["A standard deviation is published for flexion and elevation only.", ""];
  if (view.store.pose.sync === "settling") return ["The clocks of the devices are settling.", ""];
  return ["", ""];
}

/** Return the curves of an angle: seconds before the newest pose, value, band, cameras. */
export function curvesOf(store, [name, key]) {
  const newest = store.pose.t_us;
  const [times, values, upper, lower, optical] = [[], [], [], [], []];
  const gap_us = GAP_PERIODS * usualPeriod(store.poses);
  let next = 0;
  let last_us = Infinity;
  for (const pose of store.poses) {
    if (pose.t_us - last_us > gap_us) {
      // Daemon, broker or network were lost, so an unknown value ends the line.
      times.push((last_us + gap_us / 2 - newest) / 1e6);
      for (const series of [values, upper, lower, optical]) series.push(null);
    }
    last_us = pose.t_us;
    const joint = valueOf(pose.joints, name) ?? {};
    const value = joint[key] ?? null;
    const sd = sdOf(joint, key);
    times.push((pose.t_us - newest) / 1e6);
    values.push(value);
    upper.push(value !== null && sd !== null ? value + sd : null);
    lower.push(value !== null && sd !== null ? value - sd : null);
    while (next < store.opticals.length && store.opticals[next].t_us < pose.t_us) next += 1;
    optical.push(opticalAt(store.opticals, next, pose.t_us, name, key));
  }
  return [times, values, upper, lower, optical];
}

/** Return the median interval of poses, µs. */
function usualPeriod(poses) {
  const intervals = poses.slice(1).map((pose, i) => pose.t_us - poses[i].t_us).sort((a, b) => a - b);
  return intervals[Math.floor(intervals.length / 2)] ?? Infinity;
}

function noAngleReason(store) {
  if (!store.info) return "The angles are unknown: no message on bridge/info was received.";
  if (store.info.segments.length < 2) return "A limb of one segment has no joint angle. The Table view shows the orientation of the segment.";
  return "The pose contains no joint angle.";
}

/** Return the angle from the cameras at a time, interpolated between two frames. */
function opticalAt(frames, next, t_us, name, key) {
  const [before, after] = [frames[next - 1], frames[next]];
  const a = before && t_us - before.t_us < OPTICAL_GAP_US ? valueOf(before.joints, name)?.[key] ?? null : null;
  const b = after && after.t_us - t_us < OPTICAL_GAP_US ? valueOf(after.joints, name)?.[key] ?? null : null;
  if (a === null || b === null) return a ?? b;
  return a + ((b - a) * (t_us - before.t_us)) / (after.t_us - before.t_us);
}

function updateChart(view) {
  const element = byId("chart");
  if (element.clientWidth === 0 || typeof uPlot === "undefined") return;
  const data = curvesOf(view.store, view.choice);
  if (view.chart === null) view.chart = createChart(element, data, view.store);
  else view.chart.setData(data);
  updateChartCaption(view, data);
}

function updateChartCaption(view, [, values, , , optical]) {
  const known = values.filter((value) => value !== null);
  if (known.length === 0) return setText(byId("chart-caption"), "No known angle in the last 20 s.");
  const range = `${formatNumber(Math.min(...known), 0)}° to ${formatNumber(Math.max(...known), 0)}°`;
  const pairs = values.map((value, i) => [value, optical[i]]).filter(([a, b]) => a !== null && b !== null);
  let cameras = "";
  if (pairs.length > 20) {
    const rms = Math.sqrt(pairs.reduce((sum, [a, b]) => sum + (a - b) ** 2, 0) / pairs.length);
    cameras = ` · difference from the cameras ${formatNumber(rms, 1)}° RMS`;
  }
  return setText(byId("chart-caption"), `Last ${shownSeconds} s: ${range}${cameras}`);
}

/** Draw the marks in the displayed time range as numbered lines. */
function drawMarks(plot, store, color) {
  const { ctx, bbox } = plot;
  const scale = devicePixelRatio;
  ctx.save();
  Object.assign(ctx, { strokeStyle: color, fillStyle: color, lineWidth: scale, textAlign: "left", textBaseline: "top" });
  ctx.font = MARK.font.replace("12px", `${12 * scale}px`);
  ctx.setLineDash(MARK.dash.map((length) => length * scale));
  for (const event of store.events) {
    const age_s = (store.pose.t_us - event.t_us) / 1e6;
    if (event.kind !== "mark" || age_s < 0 || age_s > shownSeconds) continue;
    const x = plot.valToPos(-age_s, "x", true);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.fillText(String(event.data?.number ?? ""), x + 4 * scale, bbox.top);
  }
  ctx.restore();
}

function createChart(element, data, store) {
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(`--${name}`).trim();
  const axis = {
    stroke: color("muted"), font: "12px system-ui, sans-serif", size: 32, gap: 6,
    grid: { stroke: color("line"), width: 1 }, ticks: { show: false },
  };
  const line = (name, more) => ({ stroke: color(name), width: 2.5, points: { show: false }, spanGaps: false, ...more });
  return new uPlot(
    {
      width: element.clientWidth,
      height: element.clientHeight,
      legend: { show: false },
      cursor: { show: false },
      padding: [12, 20, 0, 0],
      scales: {
        x: { time: false, range: [-shownSeconds, 0] },
        y: { range: (_, low, high) => angleRange(low, high) },
      },
      axes: [
        { ...axis, values: (_, ticks) => ticks.map((tick) => (tick === 0 ? "now" : `${formatNumber(tick, 0)} s`)) },
        { ...axis, size: 48, values: (_, ticks) => ticks.map((tick) => formatNumber(tick, 0, "°")) },
      ],
      series: [
        {},
        line("imu"),
        line("imu", { width: 0, stroke: "transparent" }),
        line("imu", { width: 0, stroke: "transparent" }),
        line("optical", { width: 2, dash: [7, 5] }),
      ],
      bands: [{ series: [2, 3], fill: color("imu-band") }],
      hooks: { draw: [(plot) => drawMarks(plot, store, color("text"))] },
    },
    data,
    element,
  );
}

/** Return a range of the angle axis of at least 20° that ends at multiples of 10°. */
function angleRange(low, high) {
  if (low === null || high === null) return [-10, 90];
  const middle = (low + high) / 2;
  const half = Math.max(10, (high - low) / 2 + 2);
  return [Math.floor((middle - half) / 10) * 10, Math.ceil((middle + half) / 10) * 10];
}

/** Mark an outdated number and curve. */
export function updateAngleAge(view) {
  const { store } = view;
  const ageMs = poseAgeMs(store);
  if (store.pose === null) setText(byId("angle-reason"), "No pose was received.");
  const stale = store.pose !== null && ageMs > STALE_MS;
  byId("angle-panel").classList.toggle("stale", stale);
  if (stale) {
    setText(byId("angle-value"), UNKNOWN);
    setText(byId("angle-sd"), "");
    setText(byId("angle-reason"), `No pose for ${Math.round(ageMs / 1000)} s.`);
    setClass(byId("angle-reason"), "reason warning");
  }
}
