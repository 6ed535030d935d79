// The calibration in steps, one at a time, with drawn poses, instruction, progress, refusals and result.

import { guidanceOf, stepsOf } from "./calibration_steps.js";
import { createProgress } from "./calibration_progress.js";
import { resultOf } from "./calibration_result.js";
import { byId, createElement, setText } from "./dom.js";
import { createFigures } from "./pose_figures.js";
import { isRunning } from "./words.js";

const RESULT = "result";

/** Show the calibration of a store; `request(command, content)` sends a request. */
export function createCalibrateView(store, request) {
  const view = { store, request, steps: [], builtFor: null, chosen: null, recorded: null, phase: null };
  view.rail = createElement("ol", { class: "rail", "aria-label": "Steps of the calibration" });
  view.message = createElement("p", { class: "banner", role: "alert", dir: "auto", hidden: true });
  view.stage = createElement("div", { class: "stage" });
  view.result = createElement("div", { class: "panel stack result", hidden: true });
  byId("view-calibrate").append(view.rail, view.message, view.stage, view.result);
  view.progress = createProgress(() => sendRequest(view, { phase: "abort" }));

  const update = () => updateView(view);
  for (const subject of ["info", "bridge"]) store.on(subject, update);
  store.on("calibration", () => {
    const phase = store.calibration?.phase;
    if (phase !== view.phase) {
      view.phase = phase;
      view.chosen = null; // a new phase shows its own step
      view.message.hidden = true; // it contains the refusal of an earlier request
    }
    update();
  });
  update();
  return { request: (content) => sendRequest(view, content) };
}

/** Send a calibration request; show the reason if it is refused. */
async function sendRequest(view, content) {
  view.message.hidden = true;
  try {
    await view.request("calibrate", content);
  } catch (error) {
    view.message.hidden = false;
    setText(view.message, error.message);
  }
}

function updateView(view) {
  const { info, calibration } = view.store;
  build(view);
  if (!info) return;
  view.recorded = recordedPhase(calibration) ?? view.recorded;
  const shown = shownStep(view);
  for (const step of view.steps) step.panel.hidden = step.phase !== shown;
  view.result.hidden = shown !== RESULT;
  updateRail(view, shown);

  const running = isRunning(calibration?.phase);
  for (const step of view.steps) updateStep(view, step, running);
  updateResult(view);
}

/** Return the current or last recorded phase if the status names it. */
function recordedPhase(calibration) {
  const { phase, text = "" } = calibration ?? {};
  if (["align", "static", "functional"].includes(phase)) return phase;
  return /^(?:fitting the )?(align|static|functional)\b/.exec(text)?.[1] ?? null;
}

/** Return the step to show: the running step, or else the chosen step, or else the next step. */
function shownStep(view) {
  const { phase, version, kept } = view.store.calibration ?? {};
  const known = (name) => (view.steps.some((step) => step.phase === name) ? name : view.steps[0]?.phase);
  if (isRunning(phase)) return known(view.recorded);
  if (view.chosen !== null) return view.chosen;
  if (phase === "calibrated" || kept) return RESULT;
  if (phase === "aborted") return known(view.recorded ?? "static");
  const next = { uncalibrated: "align", aligned: "static", posed: "functional" }[phase];
  if (phase === "posed" && !view.steps.some((step) => step.phase === next)) return RESULT;
  return version == null ? known(next) : RESULT;
}

// The steps are built once for a limb and its cameras, so buttons keep their focus.
function build(view) {
  const { info } = view.store;
  const cameras = Object.values(info?.devices ?? {}).some((device) => device.kind === "mocap");
  const key = JSON.stringify([info?.joints, info?.segments, cameras]);
  if (!info || view.builtFor === key) return;
  view.builtFor = key;
  view.steps = stepsOf(info, cameras).map((step, i, all) => createStep(view, step, i + 1, all.length));
  view.stage.replaceChildren(...view.steps.map((step) => step.panel));
  const entries = [...view.steps, { phase: RESULT, short: "Result" }];
  view.entries = entries.map((entry, i) => createRailEntry(view, entry, i + 1));
  view.rail.replaceChildren(...view.entries.map((entry) => entry.item));
}

function createRailEntry(view, { phase, short }, number) {
  const mark = createElement("span", { class: "rail-number", "aria-hidden": "true" }, String(number));
  const note = createElement("span", { class: "hidden" });
  const choose = () => { view.chosen = phase; updateView(view); };
  const button = createElement("button", { type: "button", onclick: choose }, mark, createElement("span", { class: "rail-title" }, short), note);
  return { phase, number, mark, note, button, item: createElement("li", {}, button) };
}

function updateRail(view, shown) {
  const done = finishedSteps(view);
  const running = isRunning(view.store.calibration?.phase);
  for (const { phase, number, mark, note, button } of view.entries) {
    button.classList.toggle("done", done.has(phase));
    if (phase === shown) button.setAttribute("aria-current", "step");
    else button.removeAttribute("aria-current");
    button.disabled = running && phase !== shown;
    setText(mark, done.has(phase) ? "✓" : String(number));
    setText(note, done.has(phase) ? " done" : "");
  }
}

/** Return the completed steps of this calibration and of the active calibration. */
function finishedSteps({ store, recorded }) {
  const { phase, done = [], quality, version } = store.calibration ?? {};
  const finished = new Set(done);
  const running = isRunning(phase);
  if (version != null || phase === "calibrated") {
    if (quality?.alignment) finished.add("align");
    if (quality?.static) finished.add("static");
    if (quality?.holdout || quality?.anatomy) finished.add("functional");
    if (!running) finished.add(RESULT);
  }
  if (running) finished.delete(recorded);
  return finished;
}

function createStep(view, step, number, count) {
  const figures = createFigures(step.figures);
  const start = createElement("button", { class: "button primary", type: "button", onclick: () => sendRequest(view, { phase: step.phase }) }, step.button);
  const skip = step.phase === "align" && count > 1
    ? createElement("button", { class: "button", type: "button", onclick: () => { view.chosen = "static"; updateView(view); } }, "Skip: already aligned")
    : null;
  const again = createElement("p", { class: "banner warning", dir: "auto", hidden: true });
  const instructions = createElement(
    "div", { class: "stack" },
    again,
    createElement("ol", { class: "tasks" }, ...step.tasks.map((task) => createElement("li", {}, task))),
    createElement("p", { class: "caption" }, step.note),
    createElement("div", { class: "actions" }, start, skip),
  );
  const work = createElement("div", { class: "stack work" });
  const panel = createElement(
    "article", { class: "panel step", "aria-labelledby": `step-${step.phase}` },
    figures.root,
    createElement(
      "div", { class: "stack step-text" },
      createElement("p", { class: "number" }, `Step ${number}`),
      createElement("h2", { id: `step-${step.phase}`, class: "step-title" }, step.title),
      instructions, work,
    ),
  );
  return { ...step, panel, figures, start, again, instructions, work };
}

function updateStep(view, step, running) {
  const { bridge, calibration, progress } = view.store;
  if (step.panel.hidden) return;
  step.start.disabled = bridge !== "online";
  step.panel.classList.toggle("running", running);
  step.instructions.hidden = running;
  step.work.hidden = !running;
  if (running) {
    if (view.progress.root.parentNode !== step.work) step.work.append(view.progress.root);
    view.progress.update(calibration, progress);
  }
  const missing = running && progress?.phase === calibration.phase ? progress.data?.missing ?? [] : [];
  step.figures.highlight(missing.length > 0 ? guidanceOf(missing[0]).remedy : "");

  const aborted = calibration?.phase === "aborted" && view.recorded === step.phase;
  step.again.hidden = !aborted;
  if (aborted) setText(step.again, abortSentence(calibration));
  setText(step.start, aborted ? "Try again" : step.button);
}

function abortSentence({ text, version }) {
  const kept = version == null ? "" : ` Version ${version} stays in force.`;
  if (/^abort requested/.test(text)) return `This step was stopped.${kept}`;
  const reason = String(text).replace(/^(align|static|functional): /, "");
  return `This step ended without a result: ${reason.replace(/\.?$/, ".")}${kept}`;
}

function updateResult(view) {
  const { calibration } = view.store;
  const text = JSON.stringify(calibration);
  if (view.result.hidden || view.resultFor === text) return;
  view.resultFor = text;
  const content = calibration ? resultOf(calibration) : null;
  if (content === null) {
    view.result.replaceChildren(createElement("h2", {}, "No result yet"), createElement("p", {}, "The result of the calibration appears here after the last step."));
    return;
  }
  const buttons = [];
  if (calibration.kept) {
    buttons.push(createElement("p", {}, "This button repeats the movement and accepts its result, even if it is worse:"));
    buttons.push(createElement("button", { class: "button", type: "button", onclick: () => sendRequest(view, { phase: "functional", force: true }) }, "Move again and accept the result"));
  }
  if (calibration.quality?.online?.rounds > 0) {
    buttons.push(createElement("button", { class: "button", type: "button", onclick: () => sendRequest(view, { phase: "revert" }) }, "Discard online learning"));
  }
  view.result.replaceChildren(...content, ...buttons);
}
