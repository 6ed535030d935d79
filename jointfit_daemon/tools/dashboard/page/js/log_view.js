// The event log: newest event first, each with its level.

import { byId, createElement, setText } from "./dom.js";
import { createMarkForm, createMarker } from "./marks.js";
import { formatClock } from "./words.js";

const LEVELS = { info: ["ok", "info"], warning: ["warning", "warning"], error: ["error", "error"] };

/** Show the events of a store in a view; `request(command, content)` sends a request. */
export function createLogView(store, request) {
  const view = { visible: false, unseen: 0, onlyProblems: false };
  const list = createElement("ul", { class: "events" });
  const none = createElement("p", { class: "caption" }, "No event since this page was opened.");
  const marks = createMarkForm(createMarker(store, request));
  const box = createElement("input", { type: "checkbox" });
  box.addEventListener("change", () => { view.onlyProblems = box.checked; update(); });
  byId("view-log").append(createElement(
    "div", { class: "panel stack" },
    createElement("div", { class: "panel-head" },
      createElement("h2", {}, "Events"),
      createElement("div", { class: "filters" }, createElement("label", {}, box, "Warnings and errors only"))),
    marks.root, none, list,
  ));

  function update() {
    if (!view.visible) return;
    const shown = store.events.filter((event) => !view.onlyProblems || event.level !== "info");
    none.hidden = shown.length > 0;
    list.replaceChildren(...shown.map(createEntry));
  }

  store.on("events", () => {
    if (!view.visible && store.events[0] && store.events[0].level !== "info") view.unseen += 1;
    showCount(view);
    update();
  });
  view.show = (visible) => {
    view.visible = visible;
    if (visible) view.unseen = 0;
    showCount(view);
    update();
  };
  return view;
}

function showCount(view) {
  const count = byId("log-count");
  count.hidden = view.unseen === 0;
  setText(count, view.unseen > 99 ? "99+" : String(view.unseen));
  count.setAttribute("aria-label", `${view.unseen} new warnings`);
}

function createEntry(event) {
  const [level, word] = LEVELS[event.level] ?? ["unknown", String(event.level)];
  return createElement(
    "li", {},
    createElement("time", { datetime: new Date(event.t_us / 1000).toISOString() }, formatClock(event.t_us)),
    createElement("span", { class: `status ${level}` }, word),
    createElement("span", { class: "who", dir: "auto" }, event.id),
    createElement("span", { class: "what", dir: "auto" }, event.text),
  );
}
