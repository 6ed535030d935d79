// The calibration, step by step: poses drawn, progress, predicted errors, and the missing movement.

import { resultOf } from "./calibration_result.js";
import { byId, createElement, createTable, setText } from "./dom.js";
import { figuresOfPhase } from "./pose_figures.js";
import { calibrationSentence, formatNumber, isRunning, titleOf } from "./words.js";

const STEPS = [
  {
    phase: "align", title: "Align the sensors", button: "Start aligning",
    text: "Fix all sensors to the plate. Turn the plate by hand about all three axes until the time is over. Needed once per laboratory.",
    optical: true,
  },
  {
    phase: "static", title: "Stand still", button: "Start standing",
    text: "Put on all sensors and markers. Stand upright and still, with straight joints, facing one way.",
  },
  {
    phase: "functional", title: "Move every joint", button: "Start moving",
    text: "Move every joint through its whole range, in view of the cameras: walk, squat, sit down and stand up, circle the hip.",
    optical: true,
  },
];
const SOURCES = { unknown: "not known yet", sensors: "IMUs only" };

/** Show the calibration of a store; `request(command, content)` sends a request. */
export function createCalibrateView(store, request) {
  const view = { store, request, message: null, steps: new Map(), drawnFor: null };
  view.message = createElement("p", { class: "banner", role: "alert", hidden: true });
  view.now = createElement("div", { class: "panel stack", hidden: true });
  view.grid = createElement("div", { class: "steps" });
  view.result = createElement("div", { class: "panel stack", hidden: true });
  byId("view-calibrate").append(view.message, view.now, view.grid, view.result);
  buildProgress(view);
  const update = () => updateView(view);
  for (const subject of ["info", "calibration", "bridge"]) store.on(subject, update);
  let phase = null;
  store.on("calibration", () => {
    if (store.calibration?.phase === phase) return;
    phase = store.calibration?.phase;
    view.message.hidden = true; // the refusal of an earlier request
  });
  update();
  return { request: (content) => sendRequest(view, content) };
}

/** Send a calibration request and show a refusal. */
async function sendRequest(view, content) {
  view.message.hidden = true;
  try {
    await view.request("calibrate", content);
  } catch (error) {
    showMessage(view, error.message);
  }
}

function showMessage(view, text) {
  view.message.hidden = false;
  setText(view.message, text);
}

function buildProgress(view) {
  view.progressTitle = createElement("h2", {});
  view.progressPercent = createElement("span", { class: "digits" });
  view.bar = createElement("progress", { max: "1", "aria-label": "Progress of the phase" });
  view.progressText = createElement("p", { class: "now", dir: "auto" });
  view.missing = createElement("ul", { class: "missing", "aria-label": "Missing movement" });
  view.details = createElement("div", {});
  view.stop = createElement("button", { class: "button stop", type: "button", onclick: () => sendRequest(view, { phase: "abort" }) }, "Stop this phase");
  view.now.append(
    createElement("div", { class: "progress-head" }, view.progressTitle, view.progressPercent),
    view.bar, view.progressText, view.missing, view.details, view.stop,
  );
}

function updateView(view) {
  updateSteps(view);
  updateProgress(view);
  updateResult(view);
}

function hasCameras(info) {
  return Object.values(info?.devices ?? {}).some((device) => device.kind === "mocap");
}

function updateSteps(view) {
  const { info, calibration } = view.store;
  const key = JSON.stringify([info?.joints, hasCameras(info)]);
  if (info && view.drawnFor !== key) {
    view.drawnFor = key;
    view.steps.clear();
    const steps = STEPS.filter((step) => !step.optical || hasCameras(info));
    view.grid.replaceChildren(...steps.map((step, i) => createStep(view, step, i + 1, steps.length)));
  }
  const phase = calibration?.phase;
  for (const [name, step] of view.steps) {
    step.root.classList.toggle("running", name === phase);
    step.button.disabled = view.store.bridge !== "online" || isRunning(phase);
    const next = { uncalibrated: "align", aligned: "static", posed: "functional" }[phase];
    step.button.className = name === next ? "button primary" : "button";
  }
}

function createStep(view, step, number, count) {
  const button = createElement("button", { class: "button", type: "button", onclick: () => sendRequest(view, { phase: step.phase }) }, step.button);
  const root = createElement(
    "article", { class: "panel step" },
    createElement("p", { class: "number" }, `Step ${number} of ${count}`),
    createElement("h3", {}, step.title),
    createElement("div", { class: "figures" }, ...figuresOfPhase(step.phase, view.store.info.joints)),
    createElement("p", {}, step.text),
    button,
  );
  view.steps.set(step.phase, { root, button });
  return root;
}

function updateProgress(view) {
  const { calibration, progress } = view.store;
  const running = isRunning(calibration?.phase);
  view.now.hidden = !running;
  if (!running) return;
  const current = progress?.phase === calibration.phase ? progress : null;
  setText(view.progressTitle, calibrationSentence(calibration));
  setText(view.progressPercent, current ? formatNumber(100 * current.progress, 0, " %") : "");
  if (current) view.bar.value = current.progress;
  else view.bar.removeAttribute("value");
  setText(view.progressText, current?.text ?? calibration.text ?? "");
  view.stop.hidden = calibration.phase === "fitting";

  const missing = current?.data?.missing ?? [];
  const known = [...view.missing.children].map((item) => item.textContent);
  if (JSON.stringify(known) !== JSON.stringify(missing)) {
    view.missing.replaceChildren(...missing.map((text) => createElement("li", { dir: "auto" }, text)));
  }
  const joints = current?.data?.joints;
  view.details.replaceChildren(...(joints ? [createJointTable(joints, current.data.parts ?? {})] : []));
}

function createJointTable(joints, parts) {
  const columns = [{ name: "joint centre" }, { name: "predicted error" }, { name: "by more movement" }, { name: "arc" }, { name: "from", text: true }, { name: "state", text: true }];
  const rows = Object.entries(joints).map(([name, joint]) => [
    titleOf(name),
    joint.predicted_error_mm == null ? "–" : `± ${formatNumber(joint.predicted_error_mm, 0, " mm")}`,
    joint.noise_error_mm == null ? "–" : `± ${formatNumber(joint.noise_error_mm, 1, " mm")}`,
    formatNumber(joint.arc_deg, 0, "°"),
    SOURCES[joint.source] ?? joint.source,
    createElement("span", { class: `status ${joint.met ? "ok" : "unknown"}` }, joint.met ? "enough" : "needs more movement"),
  ]);
  const seen = Object.entries(parts).map(([name, part]) => `${name} ${formatNumber(part.seen_pct, 0, " %")}`).join(", ");
  return createElement(
    "div", { class: "stack" },
    createTable("Joint centres so far", columns, rows),
    seen ? createElement("p", { class: "caption" }, `Seen by the cameras: ${seen}`) : null,
  );
}

function updateResult(view) {
  const { calibration } = view.store;
  const content = calibration ? resultOf(calibration) : null;
  const text = JSON.stringify(calibration);
  view.result.hidden = content === null;
  if (content === null || view.resultFor === text) return;
  view.resultFor = text;
  const buttons = [];
  if (calibration.kept) {
    buttons.push(createElement("p", {}, "To use a worse result all the same, repeat the phase and accept it:"));
    buttons.push(createElement("button", { class: "button", type: "button", onclick: () => sendRequest(view, { phase: "functional", force: true }) }, "Move again and accept the result"));
  }
  if (calibration.quality?.online) {
    buttons.push(createElement("button", { class: "button", type: "button", onclick: () => sendRequest(view, { phase: "revert" }) }, "Discard online learning"));
  }
  view.result.replaceChildren(...content, ...buttons);
}
