// Stored calibrations, newest first, and the selection of the active calibration.

import { resultOf } from "./calibration_result.js";
import { byId, createElement, setText } from "./dom.js";
import { UNKNOWN, formatNumber, isRunning, titleOf } from "./words.js";

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

// The list is read again when a calibration becomes active, not at each progress message.
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
  const title = createElement("h2", {}, "Stored calibrations");
  if (data.versions.length === 0) return [title, createElement("p", {}, "No calibration is stored yet.")];
  const busy = isRunning(view.store.calibration?.phase);
  const entries = data.versions.map((entry) => createEntry(view, entry, data.in_force, busy));
  const content = [title, createElement("ul", { class: "versions" }, ...entries)];
  if (data.omitted > 0) content.push(createElement("p", { class: "caption" }, `${data.omitted} older versions are stored, too: jointfit calibrate --list`));
  return content;
}

function createEntry(view, entry, inForce, busy) {
  const made = entry.created_utc ? new Date(entry.created_utc).toLocaleString([], { dateStyle: "medium", timeStyle: "short" }) : UNKNOWN;
  const use = entry.usable && entry.version !== inForce
    ? createElement("button", { class: "button", type: "button", disabled: busy, onclick: () => useVersion(view, entry.version) }, `Use version ${entry.version}`)
    : "";
  return createElement(
    "li", {},
    createElement("h3", {}, `Version ${entry.version}`),
    createElement("time", { datetime: entry.created_utc }, made),
    createElement("span", {}, errorsOf(entry)),
    createElement("span", {}, stateOf(entry, inForce)),
    createElement("span", { class: "use" }, use),
  );
}

/** Return the error on held-out movement with its method, or the error of the last online learning. */
function errorsOf(entry) {
  const words = (table) => Object.entries(table ?? {}).map(([joint, error]) => `${titleOf(joint)} flexion ${formatNumber(error, 1)}° RMS`).join(", ");
  const learned = entry.online?.after_deg;
  if (learned) return `${words(pick(learned, Object.keys(entry.flexion_deg ?? {})))}, newest movement (online learning)`;
  const errors = words(entry.flexion_deg);
  if (errors === "") return entry.fault ? "" : "Made without cameras: error not measured";
  return `${errors}, held out (${entry.method})`;
}

const pick = (table, names) => Object.fromEntries(names.filter((name) => name in table).map((name) => [name, table[name]]));

function stateOf(entry, inForce) {
  if (entry.fault) return createElement("span", { class: "status error" }, entry.fault);
  const origin = [
    entry.restored_from == null ? "" : `copy of version ${entry.restored_from}`,
    entry.online ? `online learning, round ${entry.online.rounds}` : "",
  ].filter(Boolean).join(", ");
  if (entry.version === inForce) return createElement("span", { class: "status ok" }, ["in force", origin].filter(Boolean).join(": "));
  if (!entry.usable) return createElement("span", { class: "status unknown" }, "made for another limb");
  return origin || "stored";
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
