// Calibrations received since the page was opened, newest first.

import { resultOf } from "./calibration_result.js";
import { byId, createElement } from "./dom.js";
import { formatClock } from "./words.js";

/** Show the calibrations of a store. */
export function createHistoryView(store) {
  const root = byId("view-history");
  const update = () => {
    const note = createElement(
      "p", { class: "lead" },
      "The calibration in force, and those that replaced each other while this page is open. The daemon stores every version in its state directory.",
    );
    const panels = store.calibrations.map((calibration) => createElement(
      "article", { class: "panel stack" },
      createElement("p", { class: "caption" }, `Published at ${formatClock(calibration.t_us)}`),
      ...historyContent(calibration, calibration === store.calibrations[0]),
    ));
    if (panels.length === 0) panels.push(createElement("p", { class: "panel" }, "No calibration is in force."));
    root.replaceChildren(note, ...panels);
  };
  store.on("calibration", () => {
    // The progress of a phase arrives five times a second and changes nothing here.
    const versions = store.calibrations.map((calibration) => calibration.t_us).join();
    if (versions !== root.dataset.versions) { root.dataset.versions = versions; update(); }
  });
  update();
}

function historyContent(calibration, inForce) {
  const content = resultOf(calibration);
  if (!inForce) content[0].textContent = `Version ${calibration.version}, replaced`;
  return content;
}
