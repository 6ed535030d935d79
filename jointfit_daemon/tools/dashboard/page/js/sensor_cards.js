// One card for each device: state, rate, loss, clock and last event. Red means that a user must act.

import { byId, createElement, setClass, setText } from "./dom.js";
import { gatewayNow, valueOf } from "./store.js";
import { UNKNOWN, clockQuality, formatDuration, formatNumber } from "./words.js";

const RATE_SHARE = 0.95; // share of the output rate below which a device is slow

/** Show a card for each device of a store. */
export function createSensorCards(store) {
  const cards = new Map();
  const update = () => updateCards(store, cards);
  for (const subject of ["bridge", "info", "health", "devices", "events"]) store.on(subject, update);
  return update;
}

function updateCards(store, cards) {
  const names = store.info ? Object.keys(store.info.devices) : [];
  for (const [name, card] of cards) {
    if (!names.includes(name)) { card.root.remove(); cards.delete(name); }
  }
  for (const name of names) {
    if (!cards.has(name)) {
      cards.set(name, createCard(name));
      byId("cards").append(cards.get(name).root);
    }
    updateCard(cards.get(name), summaryOf(store, name));
  }
}

/** Return the texts of a device's card. */
export function summaryOf(store, name) {
  const device = valueOf(store.info?.devices, name) ?? {};
  const health = valueOf(store.health?.devices, name);
  const reachable = store.bridge === "online" || store.bridge === "unknown";
  const availability = (reachable && store.devices.get(name)?.availability) || "unknown";
  const flags = store.pose?.flags ?? [];
  const [level, state] = stateOf(store, name, availability, health, flags);
  const [clockLevel, clock] = availability === "online" ? clockQuality(health) : ["unknown", UNKNOWN];
  const lost = health ? health.lost / Math.max(1, health.received + health.lost) : null;
  return {
    name,
    place: device.kind === "mocap" ? "cameras" : (device.segment ?? "").replaceAll("_", " "),
    driver: device.driver ?? "",
    level, state,
    rate: availability === "online" ? formatNumber(health?.rate_hz, 1, " Hz") : UNKNOWN,
    loss: lost === null ? UNKNOWN : formatNumber(100 * lost, 2, " %"),
    clockLevel, clock,
    event: eventText(store, name),
    health,
  };
}

function stateOf(store, name, availability, health, flags) {
  if (store.bridge === "lost") return ["unknown", "Unknown: connection lost"];
  if (store.bridge === "offline") return ["unknown", "jointfitd is not running"];
  if (availability === "offline") return ["error", "No data: check cable and power"];
  if (availability !== "online") return ["unknown", "State not received"];
  if (flags.includes(`stuck:${name}`) || health?.sensor === "stuck") return ["error", "Stuck: repeats its value"];
  if (flags.includes(`slipped:${name}`)) return ["error", "Slipped on the body: fasten it"];
  if (health?.sensor === "lost") return ["error", "No data: check cable and power"];
  const wanted = store.info?.output_rate_hz;
  const slow = health?.rate_hz != null && wanted != null && health.rate_hz < RATE_SHARE * wanted
    && valueOf(store.info.devices, name)?.kind !== "mocap";
  return slow ? ["warning", "Slower than the output rate"] : ["ok", "Works"];
}

function eventText(store, name) {
  const event = store.lastEvents.get(name);
  if (!event) return "No event yet";
  const now = gatewayNow(store);
  const age = now === null ? "" : `${formatDuration((now - event.t_us) / 1e6)} ago: `;
  return `${age}${event.text}`;
}

function createCard(name) {
  const fact = (term) => {
    const value = createElement("dd", { class: "digits" });
    return { value, row: [createElement("dt", {}, term), value] };
  };
  const [rate, loss, clock] = ["Rate", "Loss", "Clock"].map(fact);
  const title = createElement("h3", { dir: "auto" }, name);
  const place = createElement("span", { dir: "auto" });
  const status = createElement("p", { class: "status" });
  const note = createElement("p", { class: "card-note", dir: "auto" });
  const root = createElement(
    "article", { class: "card", role: "listitem" },
    createElement("div", { class: "card-head" }, title, place),
    status,
    createElement("dl", { class: "facts" }, ...rate.row, ...loss.row, ...clock.row),
    note,
  );
  return { root, place, status, note, rate: rate.value, loss: loss.value, clock: clock.value };
}

function updateCard(card, summary) {
  setClass(card.root, `card ${summary.level === "error" ? "error" : summary.level === "warning" ? "warning" : ""}`.trim());
  setText(card.place, summary.place);
  setText(card.status, summary.state);
  setClass(card.status, `status ${summary.level}`);
  setText(card.rate, summary.rate);
  setText(card.loss, summary.loss);
  if (card.clock.textContent !== summary.clock) {
    card.clock.replaceChildren(createElement("span", { class: `status ${summary.clockLevel}` }, summary.clock));
  }
  setText(card.note, summary.event);
}
