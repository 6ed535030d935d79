// The Sensors view: counters and clocks of every device, the daemon, and the manual checks of axes.

import { byId, createElement, createTable, patchTable } from "./dom.js";
import { createAxesCheck } from "./axes_check.js";
import { createPhysicalTest } from "./physical_test.js";
import { summaryOf } from "./sensor_cards.js";
import { UNKNOWN, formatBytes, formatCount, formatDelay, formatNumber } from "./words.js";

/** Show the health of a store's devices in a view; `openAction(name, device)` starts a request. */
export function createSensorsView(store, link, openAction, request) {
  const view = { visible: false };
  const tables = createElement("div", { class: "stack" });
  const check = createAxesCheck(store, link);
  const action = (name, text) => createElement("button", { class: "button", type: "button", onclick: () => openAction(name) }, text);
  byId("view-sensors").append(
    createElement(
      "div", { class: "panel stack" },
      createElement(
        "div", { class: "panel-head" }, createElement("h2", {}, "Health"),
        createElement("div", { class: "actions" }, action("selftest", "Self-test"), action("rate", "Output rate…"), action("reload", "Reload rig.toml…")),
      ),
      tables,
    ),
    check.root,
    createPhysicalTest(store, request).root,
  );
  const update = () => {
    if (view.visible) patchTable(tables, createElement("div", { class: "stack" }, ...tablesOf(store, openAction)));
  };
  for (const subject of ["info", "health", "devices"]) store.on(subject, update);
  view.show = (visible) => {
    if (view.visible !== visible) check.show(visible);
    view.visible = visible;
    update();
  };
  return view;
}

function tablesOf(store, openAction) {
  if (!store.info) return [createElement("p", {}, "No rig was found yet.")];
  const number = { name: "" };
  const columns = ["device", "state", "model", "received", "used", "late", "lost", "corrupt", "rate", "delay, median", "delay, 99 %", "clock", ""]
    .map((name) => ({ ...number, name, text: ["state", "model", "clock"].includes(name) }));
  const rows = Object.keys(store.info.devices).map((name) => {
    const summary = summaryOf(store, name);
    const health = summary.health ?? {};
    const info = store.devices.get(name)?.info ?? {};
    return [
      summary.place ? `${name} · ${summary.place}` : name,
      createElement("span", { class: `status ${summary.level}` }, summary.state),
      createElement("span", { class: "model" }, [info.model, info.firmware].filter(Boolean).join(" ") || UNKNOWN),
      ...["received", "used", "late", "lost", "corrupt"].map((key) => formatCount(health[key])),
      summary.rate,
      formatDelay(health.delay_us?.p50),
      formatDelay(health.delay_us?.p99),
      createElement("span", { class: `status ${summary.clockLevel}` }, summary.clock),
      createElement("button", { class: "button small", type: "button", "aria-label": `Restart ${name}`, onclick: () => openAction("restart", name) }, "Restart…"),
    ];
  });
  const daemon = [createTable("Daemon", [{ name: "item" }, { name: "value", text: true }], daemonRows(store))];
  if (store.health?.latency) daemon.push(latencyTable(store.health.latency));
  return [createTable("Devices", columns, rows), createElement("div", { class: "pair" }, ...daemon)];
}

/** Return the latency of the frames since the last health message, by stage. */
function latencyTable(latency) {
  const stages = {
    decoded: "arrival to decoded", aligned: "to aligned", fused: "to joint angles",
    encoded: "to JSON", written: "to the broker's socket", total: "total",
  };
  const rows = Object.entries(stages).map(([stage, words]) => {
    const found = latency[`${stage}_us`] ?? {};
    return [words, ...["p50", "p99", "max"].map((key) => formatNumber(found[key] == null ? null : found[key] / 1000, 2, " ms"))];
  });
  return createTable("Latency of a pose", ["stage", "median", "99 %", "longest"].map((name) => ({ name })), rows);
}

function recordingWords({ recording }) {
  if (recording === null) return UNKNOWN;
  if (!recording.active) return "off";
  return recording.failure ? `interrupted: ${recording.failure}` : `${recording.file}, ${formatBytes(recording.written_bytes)}`;
}

function daemonRows(store) {
  const health = store.health ?? {};
  const link = health.link ?? {};
  const denied = link.denied?.length ? `; refused by the broker: ${link.denied.join(", ")}` : "";
  return [
    ["Version", store.info.software ?? UNKNOWN],
    ["Poses", `${formatCount(health.frames?.sent)} sent, ${formatCount(health.frames?.empty)} without sensors, ${formatCount(health.frames?.skipped)} skipped`],
    ["Processor and memory", `${formatNumber(health.process?.cpu_pct, 1, " %")}, ${formatNumber(health.process?.rss_bytes == null ? null : health.process.rss_bytes / 1e6, 0, " MB")}`],
    ["Messages to the broker", `${formatCount(link.sent)} sent, ${formatCount(link.dropped)} dropped${denied}`],
    ["Online learning", health.learning?.reason ? `${health.learning.state}: ${health.learning.reason}` : health.learning?.state ?? UNKNOWN],
    ["Recording", recordingWords(store)],
  ];
}
