// Stored calibrations, newest first, and the choice of the one in force.

import { resultOf } from "./calibration_result.js";
import { byId, createElement, createTable, setText } from "./dom.js";
import { UNKNOWN, formatNumber, isRunning, titleOf } from "./words.js";

const COLUMNS = ["version", "made", "error on held-out movement", "method", "state", ""]
  .map((name, i) => ({ name, text: i > 0 }));

/** Show the stored calibrations of a rig; `request(command, content)` sends a request. */
export function createHistoryView(store, request) {
  const view = { store, request, visible: false, listed: null };
  view.message = createElement("p", { class: "banner", role: "alert", hidden: true });
  view.list = createElement("div", { class: "panel stack" }, createElement("p", {}, "Reading the stored calibrations."));
  view.current = createElement("div", { class: "panel stack" });
  byId("view-history").append(view.message, view.list, view.current);
  store.on("calibration", () => refresh(view));
  view.show = (visible) => {
    view.visible = visible;
    refresh(view);
  };
  return view;
}

// The list is read again when a calibration comes into force, not with each message of progress.
function refresh(view) {
  const { calibration, base } = view.store;
  const state = JSON.stringify([base, calibration?.phase, calibration?.version]);
  if (!view.visible || view.listed === state || view.store.bridge !== "online") return;
  view.listed = state;
  const content = calibration ? resultOf(calibration) : null;
  view.current.hidden = content === null;
  view.current.replaceChildren(...(content ?? []));
  readList(view);
}

async function readList(view) {
  try {
    const data = await view.request("calibrations", {});
    view.list.replaceChildren(...listContent(view, data));
  } catch (error) {
    view.list.replaceChildren(
      createElement("h2", {}, "Stored calibrations"),
      createElement("p", {}, `The list cannot be read: ${error.message}`),
    );
  }
}

function listContent(view, data) {
  if (data.versions.length === 0) return [createElement("h2", {}, "Stored calibrations"), createElement("p", {}, "No calibration is stored yet.")];
  const busy = isRunning(view.store.calibration?.phase);
  const rows = data.versions.map((entry) => [
    String(entry.version),
    entry.created_utc ? new Date(entry.created_utc).toLocaleString([], { dateStyle: "medium", timeStyle: "short" }) : UNKNOWN,
    errorsOf(entry),
    entry.method ?? UNKNOWN,
    stateOf(entry, data.in_force),
    entry.usable && entry.version !== data.in_force
      ? createElement("button", { class: "button", type: "button", disabled: busy, onclick: () => useVersion(view, entry.version) }, `Use version ${entry.version}`)
      : "",
  ]);
  const content = [createTable("Stored calibrations", COLUMNS, rows)];
  if (data.omitted > 0) content.push(createElement("p", { class: "caption" }, `${data.omitted} older versions are stored, too: jointfit calibrate --list`));
  return content;
}

function errorsOf(entry) {
  const errors = Object.entries(entry.flexion_deg ?? {}).map(([joint, error]) => `${titleOf(joint)} flexion ${formatNumber(error, 1)}°`);
  return errors.join(", ") || "not measured";
}

function stateOf(entry, inForce) {
  if (entry.fault) return createElement("span", { class: "status error" }, entry.fault);
  if (entry.version === inForce) return createElement("span", { class: "status ok" }, "in force");
  if (!entry.usable) return createElement("span", { class: "status unknown" }, "of another limb");
  return entry.restored_from == null ? "stored" : `copy of version ${entry.restored_from}`;
}

async function useVersion(view, version) {
  view.message.hidden = true;
  try {
    await view.request("use-calibration", { version });
    view.listed = null;
    refresh(view);
  } catch (error) {
    view.message.hidden = false;
    setText(view.message, error.message);
  }
}
