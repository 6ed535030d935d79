// Conditions that limit the page without interrupting it: rights, versions, and clocks.

import { hiddenTopics } from "./access.js";
import { byId, createElement } from "./dom.js";
import { PAYLOAD_VERSION } from "./payloads.js";
import { gatewayNow } from "./store.js";
import { formatDuration, isolate } from "./words.js";

const CLOCK_S = 60;
const NEEDED_FOR = new Map(Object.entries({
  "bridge/state": "whether jointfitd runs",
  "bridge/info": "limb, joints and sensors",
  "bridge/health": "rates and clocks of the sensors",
  "calibration": "the state of the calibration",
  "pose/ui": "limb and angles",
  "device/+/availability": "which sensors send data",
}));

/** Show the notices of a page; return the function that updates them. */
export function createNotices(link, store, access, configuration) {
  const list = byId("notices");
  let shown = "";
  return () => {
    const found = noticesOf(link, store, access, configuration);
    const text = JSON.stringify(found);
    if (text === shown) return; // an equal text would restart a screen reader
    shown = text;
    list.hidden = found.length === 0;
    list.replaceChildren(...found.map(([level, sentence]) => createElement("li", { class: `notice ${level}`, dir: "auto" }, sentence)));
  };
}

function noticesOf(link, store, access, configuration) {
  const notices = configuration.remark ? [["warning", configuration.remark]] : [];
  if (link.state !== "connected") return notices;
  if (store.otherVersion !== null) notices.push(["warning", versionSentence(store, configuration)]);
  if (store.faulty !== null) {
    notices.push(["warning", `A message on ${isolate(store.faulty)} was ignored: its content is not in the format of jointfitd. Check which program publishes below ${isolate(link.base)}.`]);
  }
  const hidden = hiddenTopics(access);
  if (hidden.length > 0) notices.push(["warning", hiddenSentence(link, hidden)]);
  if (access.mayRequest === false) {
    notices.push(["info", `${account(link)} can watch only: jointfitd did not receive its requests, or this account may not read the answers. To calibrate, log in as an operator with the right to write ${isolate(link.base)}/bridge/request/+.`]);
  }
  const clock = clockSentence(store);
  if (clock !== "") notices.push(["info", clock]);
  return notices;
}

const account = (link) => (link.account.username ? `The account ${isolate(link.account.username)}` : "The account without a user name");

function hiddenSentence(link, topics) {
  const lines = topics.map((topic) => (NEEDED_FOR.has(topic) ? `${topic} (${NEEDED_FOR.get(topic)})` : topic));
  return `${account(link)} receives nothing from ${lines.join(", ")} below ${isolate(link.base)}: permit it to read them in the access list of the broker.`;
}

function versionSentence(store, configuration) {
  const { v, software } = store.otherVersion;
  const daemon = typeof software === "string" ? `jointfitd ${isolate(software)}` : "jointfitd";
  return `${daemon} sends payloads of version ${String(v)}. This page (jointfit ${configuration.version}) reads version ${PAYLOAD_VERSION} and ignores them: install the same version of both.`;
}

function clockSentence(store) {
  const now = gatewayNow(store);
  if (now === null) return "";
  const behind = Date.now() / 1000 - now / 1e6;
  if (Math.abs(behind) < CLOCK_S) return "";
  return `The clock of the gateway is ${formatDuration(Math.abs(behind))} ${behind > 0 ? "behind" : "ahead of"} the clock of this device. Times and ages on this page are from the clock of the gateway.`;
}
