// Requests to the daemon that a user starts: confirmation, fields, and the text of the response.

import { byId, createElement, createTable, setText } from "./dom.js";
import { formatBytes, formatClock, formatNumber, formatStopwatch } from "./words.js";

/**
 * Connect the menu of the header; return a function that opens an action for a device.
 *
 * `request(command, content)` sends a request; `showView(name)` changes the view.
 */
export function createActions(store, request, showView) {
  const dialog = createActionDialog();
  const open = (name, device) => openAction(dialog, ACTIONS[name](store, device), request, showView);
  const menu = byId("menu");
  menu.append(...["static", "mark", "selftest", "rate", "reload"].map((name) =>
    createElement("button", { type: "button", onclick: () => { menu.hidePopover(); open(name); } }, ACTIONS[name](store).menu)));
  menu.addEventListener("toggle", (event) => byId("menu-button").setAttribute("aria-expanded", String(event.newState === "open")));
  return open;
}

// Each action has a request, texts, an optional field, and a function for the text of the answer.
const ACTIONS = {
  static: () => ({
    menu: "Record the static pose again…", title: "Record the static pose again", button: "Start standing", view: "calibrate",
    text: "Stand upright and still, with straight joints. The new static pose corrects the headings of the sensors, for example after they were put on again. The daemon continues to publish poses.",
    command: "static",
  }),
  mark: () => ({
    menu: "Mark this instant…", title: "Mark this instant", button: "Mark now", command: "mark",
    text: "The time of the mark is the time at which jointfitd receives it. It appears in the log and in recordings.",
    field: { label: "Text", maxlength: "200", value: "mark" },
    content: (text) => ({ text }),
    answer: (data) => `Mark ${data.number} at ${formatClock(data.t_us)}: ${data.text}`,
  }),
  selftest: () => ({
    menu: "Self-test", title: "Self-test", command: "selftest", immediate: true,
    text: "Checks devices, clocks, calibration, store, broker and host.",
    answer: selfTestContent,
  }),
  stopRecording: () => ({
    menu: "", title: "Stop the recording", done: "Recording stopped", button: "Stop recording", command: "record",
    text: "jointfitd completes the file. Later data of the sensors are not recorded.",
    content: () => ({ action: "stop" }),
    answer: recordedContent,
  }),
  rate: (store) => ({
    menu: "Output rate…", title: "Output rate", button: "Change the rate", command: "rate",
    text: "Poses per second, until the next reload or restart of jointfitd. For a permanent rate, set output_rate_hz in rig.toml.",
    field: { label: "Rate, Hz", type: "number", min: "1", max: "1000", step: "any", value: String(store.info?.output_rate_hz ?? "") },
    content: (text) => ({ hz: Number(text) }),
    answer: (data) => `The output rate is ${formatNumber(data.output_rate_hz, 0, " Hz")}; before: ${formatNumber(data.before_hz, 0, " Hz")}.`,
  }),
  reload: () => ({
    menu: "Reload rig.toml…", title: "Reload rig.toml", button: "Reload", command: "reload",
    text: "jointfitd reads its configuration again. Devices with changed settings are closed and opened again, and a running calibration step ends. A faulty file changes nothing.",
    answer: (data) => `rig.toml of ${data.rig} is in force, with ${data.devices.join(", ")}.`,
  }),
  restart: (store, device) => ({
    menu: "", title: `Restart ${device}`, button: `Restart ${device}`, command: "restart-device",
    text: `jointfitd closes the port of ${device} and opens it again. Its data are missing for some seconds; other devices continue.`,
    content: () => ({ device }),
    answer: () => `${device} restarts. Its state changes to “Works” when data arrive again.`,
  }),
};

function createActionDialog() {
  const part = (name, attributes = {}) => createElement(name, attributes);
  const dialog = {
    title: part("h2", { id: "action-title", dir: "auto" }),
    text: part("p", { dir: "auto" }),
    field: part("div"),
    answer: part("div", { role: "status", class: "stack answer", dir: "auto" }),
    cancel: createElement("button", { class: "button", type: "button" }, "Cancel"),
    send: createElement("button", { class: "button primary", type: "button" }),
  };
  dialog.root = createElement(
    "dialog", { id: "action", "aria-labelledby": "action-title" },
    dialog.title, dialog.text, dialog.field, dialog.answer,
    createElement("div", { class: "buttons" }, dialog.cancel, dialog.send),
  );
  dialog.cancel.addEventListener("click", () => dialog.root.close());
  dialog.send.addEventListener("click", () => dialog.run?.());
  dialog.root.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target instanceof HTMLInputElement) { event.preventDefault(); dialog.run?.(); }
  });
  document.body.append(dialog.root);
  return dialog;
}

function openAction(dialog, action, request, showView) {
  setText(dialog.title, action.title);
  setText(dialog.text, action.text);
  dialog.text.hidden = false;
  dialog.answer.replaceChildren();
  const input = action.field ? createElement("input", { ...action.field, label: null, autocomplete: "off" }) : null;
  dialog.field.replaceChildren(...(input ? [createElement("label", {}, action.field.label, input)] : []));
  setText(dialog.send, action.button ?? "");
  dialog.send.hidden = action.immediate === true;
  setText(dialog.cancel, action.immediate ? "Close" : "Cancel");
  dialog.root.classList.toggle("wide", action.immediate === true);
  dialog.run = () => sendAction(dialog, action, input, request, showView);
  if (!dialog.root.open) dialog.root.showModal();
  input?.select();
  if (action.immediate) dialog.run();
}

async function sendAction(dialog, action, input, request, showView) {
  const value = input?.value.trim() ?? "";
  if (input && (value === "" || !input.checkValidity())) {
    showAnswer(dialog, createElement("p", { class: "bad" }, input.validationMessage || "Enter a value first."));
    return;
  }
  dialog.send.disabled = true;
  showAnswer(dialog, createElement("p", { class: "caption" }, "Waiting for the answer of jointfitd."));
  try {
    const data = await request(action.command, action.content?.(value) ?? {});
    if (action.view) {
      dialog.root.close();
      showView(action.view);
      return;
    }
    const answer = action.answer(data);
    showAnswer(dialog, ...(typeof answer === "string" ? [createElement("p", { class: "good" }, answer)] : answer));
    setText(dialog.title, action.done ?? action.title);
    dialog.send.hidden = true;
    dialog.field.replaceChildren();
    dialog.text.hidden = true;
    setText(dialog.cancel, "Close");
  } catch (error) {
    const faults = (error.faults ?? []).map((fault) => createElement("li", {}, fault.message));
    showAnswer(dialog, createElement("p", { class: "bad" }, error.message), faults.length > 1 ? createElement("ul", { class: "faults" }, ...faults) : "");
  } finally {
    dialog.send.disabled = false;
  }
}

const showAnswer = (dialog, ...content) => dialog.answer.replaceChildren(...content);

// Show the file, and the next command for this file on the gateway.
function recordedContent(data) {
  if (!data.file) return "Nothing is recorded.";
  const lost = data.lost > 0 ? `${data.lost} messages lost` : "nothing lost";
  const sentence = `Recorded ${formatStopwatch(data.duration_s)}, ${formatBytes(data.written_bytes)}, ${lost}.`;
  const failure = data.failure ? createElement("p", { class: "bad" }, `The file could not be completed: ${data.failure}. jointfitd repairs it at its next start.`) : "";
  const command = `jointfit report ${shellWord(`${data.directory}/${data.file}`)}`;
  return [
    createElement("p", { class: data.lost > 0 ? "" : "good" }, sentence), failure,
    createElement("p", {}, "For a page with angles, gait cycles and faults, run on the gateway:"),
    createElement("pre", { class: "command", tabindex: "0" }, createElement("code", {}, command)),
  ];
}

const shellWord = (text) => (/^[\w./:=@-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

const LEVELS = { ok: "ok", warning: "warning", error: "error" };

// Show the findings, then the number of passed checks.
function selfTestContent({ checks }) {
  const found = checks.filter((check) => check.level !== "ok");
  const passed = `${checks.length - found.length} of ${checks.length} checks passed.`;
  if (found.length === 0) return [createElement("p", { class: "good" }, passed)];
  const rows = found.map((check) => [
    createElement("span", { class: `status ${LEVELS[check.level] ?? "unknown"}` }, [check.check, check.id].filter(Boolean).join(" ")),
    check.text, check.remedy,
  ]);
  const columns = ["check", "found", "remedy"].map((name) => ({ name, text: true }));
  return [createTable(passed, columns, rows)];
}
