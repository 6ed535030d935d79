// The recording: its state, and the buttons to start it, to stop it, and to mark the current time.

import { byId, createElement, setClass, setText } from "./dom.js";
import { connectMarkKey, createMarkForm, createMarker } from "./marks.js";
import { recordingSeconds } from "./store.js";
import { UNKNOWN, formatBytes, formatDuration, formatStopwatch, titleOf } from "./words.js";

const RATE_AFTER_S = 30; // before this time, the growth of a file is not typical
const SHORT_S = 3600;
const LONGEST_S = 30 * 86_400;
const LOW_BYTES = 1e9;

/** Return level and text of a store's recording, for the header. */
export function recordingState(store) {
  const { recording } = store;
  if (store.bridge !== "online" || recording === null) return ["unknown", UNKNOWN];
  if (!recording.active) return ["off", "off"];
  return recording.failure ? ["error", "interrupted"] : ["recording", formatStopwatch(recordingSeconds(store))];
}

/** Show the recording of a store; return the form for marks and a function that updates the panel. */
export function createRecordingPanel(store, access, request, openAction) {
  const status = createElement("p", { class: "status unknown digits" }, UNKNOWN);
  const facts = createElement("dl");
  const note = createElement("p", { class: "caption", dir: "auto" });
  const fault = createElement("p", { class: "recorder-fault bad", role: "alert", dir: "auto", hidden: true });
  const form = createMarkForm(createMarker(store, request), { hint: true });
  const start = createElement("button", { class: "button record", type: "button" }, "Start recording");
  const stop = createElement("button", { class: "button stop-recording", type: "button", hidden: true, onclick: () => openAction("stopRecording") }, "Stop", createElement("span", { class: "more" }, " recording"), "…");
  byId("recording").append(
    createElement("div", { class: "recorder-state" }, createElement("h2", { id: "recording-title" }, "Recording"), status),
    createElement("div", { class: "recorder-facts" }, facts, note),
    form.root, start, stop, fault,
  );

  let shownFacts = "";
  let refusal = "";
  const update = () => {
    const [level, words] = recordingState(store);
    const active = store.recording?.active === true;
    const reason = disabledReason(store, access);
    setClass(status, `status digits ${level === "off" ? "unknown" : level}`);
    setText(status, words === UNKNOWN ? "Unknown" : titleOf(words));
    for (const element of [start, stop, form.button, form.text]) element.disabled = reason !== "";
    // If the button that disappears has the focus, the button that replaces it receives the focus.
    const focused = document.activeElement === (active ? start : stop);
    start.hidden = active;
    stop.hidden = !active;
    if (focused) (active ? stop : start).focus();

    const found = store.bridge === "online" ? factsOf(store) : [];
    if (JSON.stringify(found) !== shownFacts) {
      shownFacts = JSON.stringify(found);
      facts.replaceChildren(...found.map(([term, text, factLevel]) => createElement(
        "div", { class: term === "File" || term === "Last file" ? "file" : null },
        createElement("dt", {}, term),
        createElement("dd", { class: factLevel ? `status ${factLevel}` : "digits", dir: "auto" }, text),
      )));
    }
    const remark = reason || (found.some(([term]) => term.includes("ile")) ? "" : "Records all data of sensors and cameras in one file, for replay, report and export.");
    note.hidden = remark === "";
    setText(note, remark);
    const failure = active && store.bridge === "online" && store.recording.failure;
    const sentence = failure ? `Recording is interrupted: ${failure}. It resumes by itself when the disk takes data again: delete old recordings, or use a larger disk.` : refusal;
    fault.hidden = !sentence;
    setText(fault, sentence);
  };

  start.addEventListener("click", async () => {
    refusal = ""; // an earlier refusal does not apply to the new attempt
    try {
      await request("record", { action: "start" });
    } catch (error) {
      refusal = error.message;
    }
    update();
  });
  store.on("recording", () => {
    if (store.recording?.active) refusal = "";
    update();
  });
  store.on("bridge", update);
  connectMarkKey(form, () => disabledReason(store, access) === "");
  update();
  return update;
}

/** Return the reason why the buttons are disabled; empty if they are enabled. */
function disabledReason(store, access) {
  if (store.bridge === "lost") return "The page lost its connection: the state of the recording is unknown.";
  if (store.bridge === "offline") return "jointfitd is not running. At its next start, it completes the file that it was writing.";
  if (store.bridge !== "online") return "Waiting for jointfitd.";
  if (access.mayRequest === false) return "This account can watch only: log in as an operator to record.";
  return "";
}

/** Return terms, texts and levels of the current or the last recording. */
function factsOf(store) {
  const { recording } = store;
  if (recording === null) return [];
  const { active, file, written_bytes: bytes, lost, free_bytes: free } = recording;
  const facts = [];
  if (file) facts.push([active ? "File" : "Last file", file], ["Size", formatBytes(bytes)]);
  if (file && !active) facts.push(["Duration", formatStopwatch(recording.duration_s)]);
  if (file) facts.push(["Lost", lost > 0 ? `${lost} messages` : "nothing", lost > 0 ? "warning" : ""]);
  if (Number.isFinite(free)) facts.push(["Free", ...freeSpace(recording, free)]);
  return facts;
}

// Return the time for which the free space suffices at the growth rate of this recording.
function freeSpace({ active, duration_s: duration, written_bytes: bytes }, free) {
  if (free < 1e6) return ["nothing", "warning"];
  const rest_s = active && duration > RATE_AFTER_S && bytes > 0 ? (free * duration) / bytes : Infinity;
  const enough = rest_s < LONGEST_S ? `, for ${formatDuration(rest_s)}` : "";
  return [`${formatBytes(free)}${enough}`, rest_s < SHORT_S || free < LOW_BYTES ? "warning" : ""];
}
