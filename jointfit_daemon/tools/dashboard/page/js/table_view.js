// The numbers of the Live view as tables, for screen readers and for copying.

import { angleKeys } from "./angle_view.js";
import { byId, createTable } from "./dom.js";
import { valueOf } from "./store.js";
import { angleName, flagSentence, formatNumber, titleOf } from "./words.js";
import { createElement } from "./dom.js";

const INTERVAL_MS = 1000;

/** Show the newest pose of a store as tables, once a second. */
export function createTableView(store) {
  const view = { visible: false };
  const panel = createElement("div", { class: "panel stack" });
  byId("view-table").append(panel);
  const update = () => { if (view.visible) panel.replaceChildren(...tablesOf(store)); };
  setInterval(() => {
    // A table with the focus or a selection is not updated.
    if (!panel.contains(document.activeElement) && String(getSelection()) === "") update();
  }, INTERVAL_MS);
  view.show = (visible) => { view.visible = visible; update(); };
  return view;
}

function tablesOf(store) {
  const { pose, info, optical } = store;
  if (!pose || !info) return [createElement("p", {}, "No pose was received yet.")];
  const names = info.joints;
  const angles = names.flatMap((name) => {
    const joint = valueOf(pose.joints, name) ?? {};
    return angleKeys(joint).map((key) => [
      `${titleOf(name)} ${angleName(key)}`, formatNumber(joint[key], 1),
      /^(flexion|elevation)/.test(key) ? formatNumber(joint.sd_deg, 1) : "–",
      formatNumber(joint[`${key}_s`], 0),
      formatNumber(valueOf(optical?.joints, name)?.[key], 1),
    ]);
  });
  const positions = names.map((name) => {
    const joint = valueOf(pose.joints, name) ?? {};
    return [titleOf(name), ...[0, 1, 2].map((i) => formatNumber(joint.p_m?.[i], 3)), formatNumber(joint.sd_m == null ? null : joint.sd_m * 1000, 0)];
  });
  const segments = info.segments.map((name) => {
    const segment = valueOf(pose.segments, name) ?? {};
    return [titleOf(name), ...[0, 1, 2, 3].map((i) => formatNumber(segment.q?.[i], 4)), formatNumber(segment.sd_deg, 1), segment.used?.join(", ") || "none"];
  });
  const columns = (...names_) => names_.map((name) => ({ name, text: name === "sensors in use" || name === "meaning" }));
  const tables = [
    createElement("div", { class: "pair" },
      createTable("Joint angles", columns("angle", "value, °", "sd, °", "rate, °/s", "cameras, °"), angles),
      createTable("Joint positions", columns("joint", "x, m", "y, m", "z, m", "sd, mm"), positions)),
    createTable("Segment orientations (quaternion, segment to world)", columns("segment", "w", "x", "y", "z", "sd, °", "sensors in use"), segments),
  ];
  const flags = (pose.flags ?? []).map((flag) => [flag, flagSentence(flag)]);
  if (flags.length > 0) tables.push(createTable("Limitations of this pose", columns("flag", "meaning"), flags));
  return tables;
}
