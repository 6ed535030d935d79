// Header of the page: rig, state as text, broker, clock, and the most important button.

import { byId, createElement, setClass, setText } from "./dom.js";
import { recordingState } from "./recording_panel.js";
import { gatewayNow, poseAgeMs } from "./store.js";
import { calibrationSentence, formatClock, isRunning } from "./words.js";

const SILENT_MS = 5000; // poses arrive with or without sensors, by default at 10 Hz (pose_ui_hz)
const RETAINED_MS = 1000; // retained messages arrive within this time after a connection

/**
 * Return the state of link, daemon and calibration: level, text, and the fault for the banner. With
 * `now_us`, the text contains the age of the calibration.
 */
export function pageState(link, store, now_us = null) {
  if (link.state === "lost") return { level: "error", words: "Connection lost", loss: link.reason };
  if (link.state === "refused") return { level: "error", words: "Not logged in", loss: link.reason };
  if (link.state === "connecting") return { level: "", words: "Connecting to the broker" };
  if (link.base === null) return { level: "", words: link.rigs > 1 ? "Choose a rig" : "Looking for rigs on the broker" };
  if (store.otherVersion !== null) return { level: "error", words: "jointfitd has another version" };
  if (store.bridge === "offline") {
    return {
      level: "error", words: "jointfitd is not running",
      loss: "jointfitd stopped or lost its broker. The page continues when jointfitd is back. Check it with: systemctl status jointfitd",
    };
  }
  if (store.received.has("pose/ui") && poseAgeMs(store) > SILENT_MS) {
    return {
      level: "error", words: "jointfitd sends nothing",
      loss: "jointfitd is connected to the broker, but sends no poses. The page continues when they return. Check it with: systemctl status jointfitd",
    };
  }
  if (store.bridge !== "online" && store.pose === null) return { level: "", words: "Waiting for jointfitd" };
  if (store.calibration === null) return { level: "", words: "Running; the state of the calibration was not received" };
  const phase = store.calibration?.phase;
  return { level: phase === "aborted" || store.calibration?.kept ? "warning" : "", words: calibrationSentence(store.calibration, now_us) };
}

/** Show the header of a store; `actions` has reconnect, logIn, calibrate and stop. */
export function createHeader(link, store, configuration, actions) {
  const button = byId("main-action");
  let action = null;
  button.addEventListener("click", () => action?.());

  const update = () => {
    const state = pageState(link, store, gatewayNow(store));
    setText(byId("rig-name"), store.info?.rig ?? link.base ?? "jointfitd");
    document.title = store.info?.rig ? `${store.info.rig} – jointfitd` : "jointfitd";
    setText(byId("rig-state"), state.words);
    setClass(byId("rig-state"), `state ${state.level}`.trim());
    setText(byId("broker-text"), link.state === "connected" ? configuration.broker : `${configuration.broker}: not connected`);
    const [level, words] = recordingState(store);
    setText(byId("recording-fact"), words);
    setClass(byId("recording-fact"), `digits status ${level === "off" ? "unknown" : level}`);
    updateBanner(state.loss ?? "");
    let label, kind, enabled;
    ({ label, kind, enabled = true, action } = mainAction(link, store, actions));
    setText(button, label);
    setClass(button, `button ${kind}`);
    button.disabled = !enabled;
  };
  for (const subject of ["bridge", "info", "calibration", "recording"]) store.on(subject, update);
  setInterval(() => {
    const now = gatewayNow(store);
    setText(byId("gateway-clock"), formatClock(now ?? NaN));
  }, 1000);
  return update;
}

/** Return label, kind and function of the most important button. */
function mainAction(link, store, actions) {
  if (link.state === "refused") return { label: "Log in", kind: "primary", action: actions.logIn };
  if (link.state === "lost") return { label: "Reconnect", kind: "primary", action: actions.reconnect };
  if (store.bridge !== "online") return { label: "Calibrate", kind: "", enabled: false, action: null };
  const phase = store.calibration?.phase;
  if (phase === "fitting") return { label: "Computing", kind: "", enabled: false, action: null };
  if (isRunning(phase)) return { label: "Stop", kind: "stop", action: actions.stop };
  const kind = phase === "calibrated" ? "" : "primary";
  return { label: "Calibrate", kind, action: actions.calibrate };
}

function updateBanner(text) {
  const banner = byId("banner");
  banner.hidden = text === "";
  setText(banner, text);
}

/** Explain a live view without poses: no rig, no daemon, or no calibration. */
export function updateEmptyState(link, store, configuration, rigs, choose) {
  const empty = byId("empty");
  const known = (store.pose?.segments && Object.values(store.pose.segments).some((segment) => segment.q)) ?? false;
  const content = emptyContent(link, store, configuration, rigs, choose, known);
  empty.hidden = content === null;
  for (const id of ["limb-panel", "angle-panel"]) byId(id).hidden = content !== null && !known;
  if (content === null) { empty.dataset.kind = ""; return; }
  if (empty.dataset.kind === content.kind) return; // without a change, buttons keep their focus
  empty.dataset.kind = content.kind;
  empty.replaceChildren(...content.children);
}

function emptyContent(link, store, configuration, rigs, choose, known) {
  if (link.state === "lost" && store.pose === null) {
    return { kind: "lost", children: [
      createElement("h2", {}, "Not connected"),
      createElement("p", {}, "The page tries to connect every 1.5 seconds and continues by itself. Check the broker, and start the dashboard with the address of the broker:"),
      createElement("pre", { tabindex: "0" }, createElement("code", {}, "systemctl status mosquitto\njointfit dashboard --broker mqtt://localhost:1883")),
    ] };
  }
  if (link.state === "refused" && store.pose === null) {
    return { kind: "refused", children: [
      createElement("h2", {}, "Log in to see the rig"),
      createElement("p", {}, "The broker has accounts. Ask its administrator for an account that may read the topics of the rig."),
    ] };
  }
  if (link.state !== "connected") return null;
  if (link.base === null && rigs.size > 1) {
    return { kind: `rigs ${[...rigs.keys()].join()}`, children: [
      createElement("h2", {}, "Several rigs use this broker"),
      createElement("p", {}, "Choose the rig to show. The list also contains rigs whose daemon is stopped."),
      ...[...rigs].map(([base, info]) =>
        createElement("button", { class: "button", type: "button", dir: "auto", onclick: () => choose(base) }, `${info.rig} (${base})`)),
    ] };
  }
  if (store.otherVersion !== null) {
    return { kind: "version", children: [
      createElement("h2", {}, "This page cannot read the messages of jointfitd"),
      createElement("p", {}, "Page and daemon have different versions. Install the same version of both, then open the page again."),
    ] };
  }
  if (store.bridge === "unknown" && store.pose === null) {
    if (performance.now() - link.sinceMs < RETAINED_MS) return null;
    return { kind: "no daemon", children: [
      createElement("h2", {}, `Waiting for jointfitd on ${configuration.broker}`),
      createElement("p", {}, "The broker answers, but no rig publishes on it. Start the daemon with the configuration of the rig:"),
      createElement("pre", { tabindex: "0" }, createElement("code", {}, "jointfitd --config rig.toml")),
      createElement("p", { class: "caption" }, "If the daemon runs: host and port under [mqtt] in its rig.toml must be those of this broker, and your account must have the right to read the topics of the rig."),
    ] };
  }
  const phase = store.calibration?.phase;
  if (store.bridge === "online" && !known && (isRunning(phase) || ["aligned", "posed", "aborted"].includes(phase))) {
    const words = calibrationSentence(store.calibration);
    return { kind: `calibrating ${words}`, children: [
      createElement("h2", { dir: "auto" }, words),
      createElement("p", {}, "The limb and its joint angles appear here after the last step. The view Calibrate shows each step with its progress."),
      createElement("button", { class: "button primary", type: "button", onclick: () => { location.hash = "calibrate"; } }, isRunning(phase) ? "Show this step" : "Show the steps"),
    ] };
  }
  if (store.bridge === "online" && phase === "uncalibrated") {
    const cameras = Object.values(store.info?.devices ?? {}).some((device) => device.kind === "mocap");
    const steps = cameras
      ? "A calibration takes about two minutes: turn the sensors on a plate, stand still, move every joint."
      : "A calibration takes a few seconds: stand still.";
    return { kind: `uncalibrated ${cameras}`, children: [
      createElement("h2", {}, "Not calibrated yet"),
      createElement("p", {}, `The sensors send data, but their positions on the body are unknown. ${steps}`),
      createElement("button", { class: "button primary", type: "button", onclick: () => { location.hash = "calibrate"; } }, "Show the steps"),
    ] };
  }
  return null;
}
