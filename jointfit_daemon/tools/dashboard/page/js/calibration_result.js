// The quality of a calibration as text and tables.

import { createElement, createTable } from "./dom.js";
import { UNKNOWN, formatNumber, titleOf } from "./words.js";

const millimetres = (metres) => (metres == null ? UNKNOWN : `± ${formatNumber(metres * 1000, 0, " mm")}`);

const sorted = (table) => Object.entries(table ?? {}).sort(([a], [b]) => a.localeCompare(b, undefined, { numeric: true }));

/** Return the elements that describe a calibration status; null if there is no result. */
export function resultOf(calibration) {
  const { phase, kept, quality } = calibration;
  if (phase === "aligned") {
    return [createElement("h2", {}, "Sensors aligned"), createElement("p", {}, "Put the sensors on the body, then stand still."), ...alignmentTable(quality)];
  }
  if (phase === "posed" && calibration.version == null) return [createElement("h2", {}, "Static pose recorded"), ...staticTable(quality)];
  if (phase !== "calibrated" && calibration.version == null) return null;
  const title = calibration.version == null ? "Calibration in force" : `Calibration in force: version ${calibration.version}`;
  return [
    createElement("h2", {}, title),
    kept ? createElement("p", { class: "bad", dir: "auto" }, `The last result was rejected: ${kept}`) : createElement("p", { class: "good" }, summary(quality)),
    createElement("div", { class: "pair" }, ...jointTable(quality), ...holdoutTable(quality), ...onlineTable(quality), ...staticTable(quality), ...alignmentTable(quality)),
  ];
}

function summary(quality) {
  const holdout = quality?.holdout;
  const errors = Object.entries(holdout?.flexion_deg ?? {})
    .map(([joint, byMethod]) => [joint, byMethod[holdout.method]])
    .filter(([, error]) => typeof error === "number")
    .map(([joint, error]) => `${titleOf(joint)} flexion ${formatNumber(error, 1)}° RMS`);
  if (errors.length === 0) return "This calibration was made without cameras, so its error was not measured.";
  return `Error on movement that the fit did not use: ${errors.join(", ")}.`;
}

function jointTable(quality) {
  const anatomy = quality?.anatomy;
  if (!anatomy) return [];
  const rows = Object.entries(anatomy.joints ?? {}).map(([name, joint]) => [titleOf(name), millimetres(joint.sd_m), formatNumber(joint.arc_deg, 0, "°"), joint.source]);
  const lengths = Object.entries(anatomy.lengths_m ?? {}).map(([name, length]) => [titleOf(name), formatNumber(length * 1000, 0, " mm"), millimetres(anatomy.length_sd_m?.[name]), anatomy.length_sources?.[name] ?? UNKNOWN]);
  return [
    createTable("Joint centres", [{ name: "joint" }, { name: "sd per axis" }, { name: "arc" }, { name: "from", text: true }], rows),
    createTable("Segment lengths", [{ name: "segment" }, { name: "length" }, { name: "sd" }, { name: "from", text: true }], lengths),
  ];
}

function holdoutTable(quality) {
  const holdout = quality?.holdout;
  if (!holdout) return [];
  const rows = [
    ...Object.entries(holdout.segments_deg ?? {}).map(([name, errors]) => [titleOf(name), errors]),
    ...Object.entries(holdout.flexion_deg ?? {}).map(([name, errors]) => [`${titleOf(name)} flexion`, errors]),
  ].map(([name, errors]) => [name, formatNumber(errors[holdout.method], 1, "°"), formatNumber(errors.mean, 1, "°"), formatNumber(errors.single, 1, "°")]);
  return [createTable("Held-out error against the cameras, RMS", [{ name: "part" }, { name: "in force" }, { name: "plain mean" }, { name: "one sensor" }], rows)];
}

function onlineTable(quality) {
  const online = quality?.online;
  if (!online?.rounds) return [];
  const rows = Object.keys(online.after_deg ?? {}).map((name) => [
    quality.holdout?.flexion_deg && name in quality.holdout.flexion_deg ? `${titleOf(name)} flexion` : titleOf(name),
    ...[online.before_deg, online.after_deg, online.known_after_deg].map((errors) => formatNumber(errors?.[name], 1, "°")),
  ]);
  const columns = [{ name: "part" }, { name: "before" }, { name: "after" }, { name: "earlier movement" }];
  return [createTable(`Online learning, round ${online.rounds}: error on the newest movement, RMS`, columns, rows)];
}

function staticTable(quality) {
  const pose = quality?.static;
  if (!pose) return [];
  const rows = sorted(pose.spread_deg).map(([name, spread]) => [name, formatNumber(spread, 1, "°")]);
  return [createTable(`Static pose, still for ${formatNumber(pose.still_s, 1)} s`, [{ name: "sensor" }, { name: "movement" }], rows)];
}

function alignmentTable(quality) {
  const alignment = quality?.alignment;
  if (!alignment) return [];
  const rows = sorted(alignment).map(([name, sensor]) => [name, formatNumber(sensor.error_deg, 1, "°"), formatNumber(sensor.rms_deg, 1, "°"), formatNumber(sensor.lag_ms, 1, " ms")]);
  return [createTable("Alignment on the plate", [{ name: "sensor" }, { name: "error" }, { name: "residual" }, { name: "lag" }], rows)];
}
