// Progress of the running phase: share, instruction, missing movements, and predicted errors.

import { guidanceOf } from "./calibration_steps.js";
import { createElement, createTable, patchTable, setText } from "./dom.js";
import { UNKNOWN, formatNumber, titleOf } from "./words.js";

const SOURCES = { unknown: "not known yet", sensors: "IMUs only" };

/** Return the elements of the progress; `stop()` ends the phase. */
export function createProgress(stop) {
  const percent = createElement("span", { class: "digits percent" });
  const bar = createElement("progress", { max: "1", "aria-label": "Progress of this step" });
  const now = createElement("p", { class: "now", dir: "auto", "aria-live": "polite" });
  const missing = createElement("ul", { class: "missing", "aria-label": "Missing movements" });
  const joints = createElement("div", { class: "joints" });
  const seen = createElement("p", { class: "caption", dir: "auto" });
  const button = createElement("button", { class: "button stop", type: "button", onclick: stop }, "Stop this step");
  const root = createElement(
    "div", { class: "stack" },
    createElement("div", { class: "progress-head" }, bar, percent), now, missing, joints, seen, button,
  );

  const update = (calibration, progress) => {
    const current = progress?.phase === calibration.phase ? progress : null;
    const fitting = calibration.phase === "fitting";
    setText(percent, current ? formatNumber(100 * current.progress, 0, " %") : "");
    if (current) bar.value = current.progress;
    else bar.removeAttribute("value");
    button.hidden = fitting;

    const entries = (current?.data?.missing ?? []).map(guidanceOf);
    setText(now, instruction(calibration, current, entries));
    updateMissing(missing, entries);
    updateJoints(joints, current?.data?.joints);
    const parts = Object.entries(current?.data?.parts ?? {}).map(([name, part]) => `${name} ${formatNumber(part.seen_pct, 0, " %")}`);
    setText(seen, parts.length > 0 ? `Frames in which the cameras see the markers: ${parts.join(", ")}` : "");
  };
  return { root, update };
}

/** Return the most important sentence for the user. */
function instruction(calibration, current, entries) {
  if (calibration.phase === "fitting") return "Computing the result. The sensors continue to stream.";
  if (entries.length > 0) return sentence(entries[0].remedy);
  return sentence(current?.text ?? calibration.text ?? "");
}

const sentence = (text) => text.charAt(0).toLocaleUpperCase() + text.slice(1);

// Entries are changed in place, because the numbers change five times per second.
function updateMissing(list, entries) {
  while (list.children.length > entries.length) list.lastChild.remove();
  while (list.children.length < entries.length) list.append(createElement("li", { dir: "auto" }, createElement("b", {}), createElement("span", {}), createElement("small", {})));
  entries.forEach(({ object, found, remedy }, i) => {
    const [name, what, why] = list.children[i].children;
    setText(name, titleOf(object));
    setText(what, remedy);
    setText(why, found);
  });
}

const COLUMNS = [
  { name: "joint" }, { name: "centre" }, { name: "random error" }, { name: "arc" },
  { name: "determined by", text: true }, { name: "movement", text: true },
];

function updateJoints(root, joints) {
  if (!joints) { root.replaceChildren(); return; }
  const rows = Object.entries(joints).map(([name, joint]) => [
    titleOf(name),
    errorText(joint.predicted_error_mm, 0),
    errorText(joint.noise_error_mm, 1),
    formatNumber(joint.arc_deg, 0, "°"),
    SOURCES[joint.source] ?? joint.source,
    createElement("span", { class: `status ${joint.met ? "ok" : "unknown"}` }, joint.met ? "enough" : "not yet"),
  ]);
  patchTable(root, createTable("Predicted errors of the joint centres", COLUMNS, rows));
}

const errorText = (error_mm, decimals) => (error_mm == null ? UNKNOWN : `± ${formatNumber(error_mm, decimals, " mm")}`);
