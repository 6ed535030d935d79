// Marks: a form and a key that label the current time in the log and in a recording.

import { byId, createElement, setText } from "./dom.js";
import { formatClock, isolate } from "./words.js";

const KEY = "m";
const DEFAULT_TEXT = "mark";
const SHOWN_MS = 5000;
const STORED_OFF = "jointfit-mark-key-off";

/** Return a function that marks the current time. It returns the answer as text, or throws an Error. */
export function createMarker(store, request) {
  return async (text) => {
    const data = await request("mark", { text: text.trim() || DEFAULT_TEXT });
    const where = store.recording?.active === false ? " (in the log only, because no recording runs)" : "";
    return `Mark ${data.number} at ${formatClock(data.t_us)}: ${isolate(data.text)}${where}`;
  };
}

/**
 * Return a form that marks the current time with a text. The text remains selected, so Enter sends it
 * again, and typing replaces it. If `hint` is true, the button shows the key M.
 */
export function createMarkForm(mark, { hint = false } = {}) {
  const text = createElement("input", { maxlength: "200", "aria-label": "Text of the mark", placeholder: "Text of a mark", autocomplete: "off" });
  const note = createElement("span", { class: "mark-note", role: "status", dir: "auto" });
  const key = hint ? createElement("kbd", { "aria-hidden": "true" }, KEY.toUpperCase()) : null;
  const button = createElement("button", { class: "button", type: "submit", "aria-keyshortcuts": hint ? KEY : null }, hint ? "Mark" : "Mark this instant", key);
  const root = createElement("form", { class: "mark-form" }, text, button, note);
  const send = () => showAnswer(note, mark(text.value));
  root.addEventListener("submit", (event) => {
    event.preventDefault();
    send();
    text.select();
  });
  text.addEventListener("keydown", (event) => { if (event.key === "Escape") text.blur(); });
  return { root, text, button, note, key, send };
}

async function showAnswer(note, answer) {
  try {
    const words = await answer;
    note.classList.remove("bad");
    setText(note, words);
  } catch (error) {
    note.classList.add("bad");
    setText(note, error.message);
  }
}

/**
 * Mark the current time at the key M in every view, unless a text field or a dialog has the focus, or the
 * user has disabled the key. The answer appears in the form. If the form is hidden, the answer also appears
 * over the page for some seconds.
 */
export function connectMarkKey(form, mayMark) {
  const box = byId("mark-key");
  const toast = byId("toast");
  const update = () => { form.key.hidden = !box.checked; };
  box.checked = localStorage.getItem(STORED_OFF) === null;
  box.addEventListener("change", () => {
    if (box.checked) localStorage.removeItem(STORED_OFF);
    else localStorage.setItem(STORED_OFF, "1");
    update();
  });
  update();

  let timer = 0;
  new MutationObserver(() => {
    if (form.root.offsetParent !== null || form.note.textContent === "") return;
    setText(toast, form.note.textContent);
    clearTimeout(timer);
    timer = setTimeout(() => setText(toast, ""), SHOWN_MS);
  }).observe(form.note, { childList: true });

  document.addEventListener("keydown", (event) => {
    const typing = event.target.closest?.("input:not([type=checkbox]), select, textarea, dialog");
    if (event.key.toLowerCase() !== KEY || event.repeat || event.ctrlKey || event.altKey || event.metaKey || typing || !box.checked || !mayMark()) return;
    event.preventDefault();
    form.send();
  });
}
