// The physical test of one sensor: the page guides three rotations by hand, and the daemon evaluates them.

import { createElement, setClass, setText } from "./dom.js";
import { formatNumber } from "./words.js";

const ASK_MS = 700;
const LEAD = "The daemon checks whether world, axes and quaternion direction of a sensor are as configured. Lay the sensor flat, with its z axis up, and start. Its data are missing for some seconds, because the daemon opens its port again.";

/** Return the panel of the test; `request(command, content)` sends a request to the daemon. */
export function createPhysicalTest(store, request) {
  const choice = createElement("select", { id: "tested-sensor" });
  const start = createElement("button", { class: "button primary", type: "button" }, "Start the test");
  const stop = createElement("button", { class: "button", type: "button", hidden: true }, "Stop the test");
  const status = createElement("p", { class: "test-status", role: "status", dir: "auto" });
  const steps = createElement("ol", { class: "test-steps", hidden: true });
  const outcome = createElement("div", { class: "stack", dir: "auto" });
  const root = createElement(
    "div", { class: "panel stack", id: "physical-test" },
    createElement("h2", {}, "Physical test of a sensor"),
    createElement("p", { class: "lead" }, LEAD),
    createElement("div", { class: "actions test-actions" }, createElement("label", { for: "tested-sensor" }, "Sensor "), choice, start, stop),
    status, steps, outcome,
  );

  let running = 0; // number of the running test; 0 without a test
  let count = 0;
  const setRunning = (number) => {
    const focused = document.activeElement === (number ? start : stop);
    running = number;
    choice.disabled = start.hidden = number !== 0;
    stop.hidden = number === 0;
    if (focused) (number ? stop : start).focus(); // the button that replaces the focused button
  };
  const show = (data) => {
    steps.hidden = data.state === "finished";
    showSteps(steps, data);
    setText(status, wordsOf(data));
    setClass(status, classOf(data));
    if (data.result) outcome.replaceChildren(...outcomeOf(data));
  };

  start.addEventListener("click", async () => {
    const number = ++count;
    const device = choice.value;
    setRunning(number);
    outcome.replaceChildren();
    setClass(status, "test-status");
    setText(status, `Opening ${device} …`);
    try {
      let data = await request("physical-test", { device, action: "start" });
      while (running === number) {
        show(data);
        if (data.state === "finished" || data.state === "failed") break;
        await new Promise((resolve) => { setTimeout(resolve, ASK_MS); });
        if (running === number) data = await request("physical-test", { device, action: "status" });
      }
    } catch (error) {
      if (running === number) {
        setText(status, error.message);
        setClass(status, "test-status bad");
      }
    }
    if (running === number) setRunning(0);
  });
  stop.addEventListener("click", () => {
    setRunning(0);
    steps.hidden = true;
    setClass(status, "test-status");
    setText(status, "Stopped.");
    request("physical-test", { device: choice.value, action: "stop" }).catch(() => undefined); // without this request, the test ends by itself
  });

  const update = () => {
    const sensors = Object.keys(store.info?.devices ?? {}).filter((name) => name !== "mocap");
    root.hidden = sensors.length === 0;
    if (running === 0 && sensors.join("\n") !== [...choice.options].map((option) => option.value).join("\n")) {
      choice.replaceChildren(...sensors.map((name) => createElement("option", { value: name }, name)));
    }
  };
  store.on("info", update);
  update();
  return { root };
}

// The list shows the current step, so the status line is for screen readers only.
function classOf({ state, result }) {
  if (state === "finished") return `test-status status ${result.agrees ? "ok" : "error"}`;
  return { turning: "test-status visually-hidden", failed: "test-status bad" }[state] ?? "test-status";
}

function wordsOf({ state, device, step, steps, text, result }) {
  if (state === "opening") return `Opening ${device} …`;
  if (state === "failed") return text;
  if (state === "turning") return `Step ${step + 1} of ${steps.length}: ${steps[step]}`;
  return result.lines[0];
}

function showSteps(list, { state, step, steps }) {
  list.replaceChildren(...steps.map((text, index) => createElement(
    "li", { class: index < step ? "done" : null, "aria-current": state === "turning" && index === step ? "step" : null },
    text, index < step ? createElement("span", { class: "done-mark" }, " ✓ done") : null,
  )));
}

function outcomeOf({ device, rotations, result }) {
  const measured = createElement(
    "ul", { class: "test-rotations" },
    ...rotations.map((name, index) => createElement("li", {}, `${name}: ${formatNumber(result.deviations_deg[index], 0, "°")} from the requested rotation`)),
  );
  const found = createElement("p", {}, `${device} sends: ${result.found}`);
  if (result.agrees) return [measured, found];
  const [, ...lines] = result.lines;
  if (result.rig_toml.length === 0) return [measured, found, ...lines.map((line) => createElement("p", {}, line))];
  const blocks = [...result.rig_toml, ...result.alternatives].map((keys, index) => createElement(
    "div", { class: "stack" },
    createElement("p", {}, index === 0 ? `Add to the [[imu]] table of ${device} in rig.toml, then reload rig.toml:` : "Or, with another heading:"),
    createElement("pre", { class: "command", tabindex: "0", "aria-label": "Lines for rig.toml" }, keys),
  ));
  return [measured, found, ...blocks];
}
