// State of the rig, from the messages below its base topic (docs/mqtt.md). Names are from a
// configuration and can be any text, so they are keys of maps, never of plain objects.

import { PAYLOAD_VERSION, hasForm } from "./payloads.js";

const SHOWN_S = 20;
const CLOCK_WINDOW_MS = 60_000; // clocks drift apart by less than 10 ms within this time
const EVENTS = 300;

/** Return an empty state. */
export function createStore() {
  const listeners = new Map();
  const store = {
    base: null,
    bridge: "unknown",
    info: null,
    health: null,
    calibration: null,
    progress: null,
    /** State of the recording, with the gateway time `t_us` and the browser time `receivedMs`. */
    recording: null,
    devices: new Map(),
    lastEvents: new Map(),
    events: [],
    pose: null,
    poseReceivedMs: null,
    optical: null,
    opticalReceivedMs: null,
    sensors: null,
    sensorsReceivedMs: null,
    poses: [],
    opticals: [],
    clock: null,
    messages: 0,
    /** Topics received since the page connected. */
    received: new Set(),
    /** Version and software of a daemon whose payloads the page cannot read, or null. */
    otherVersion: null,
    /** Topic of a message that is not from jointfitd, or null. */
    faulty: null,

    /** Call `listener` after every change of a subject. */
    on(subject, listener) {
      if (!listeners.has(subject)) listeners.set(subject, []);
      listeners.get(subject).push(listener);
    },
    /** Report a change of a subject. */
    changed(subject) {
      for (const listener of listeners.get(subject) ?? []) listener(store);
    },
    /** Process one message; `topic` is relative to the base topic. */
    take(topic, payload) {
      store.messages += 1;
      store.received.add(topic);
      if ((payload.v ?? PAYLOAD_VERSION) !== PAYLOAD_VERSION) {
        store.otherVersion = { v: payload.v, software: payload.software ?? store.otherVersion?.software };
        return;
      }
      if (!hasForm(topic, payload)) { store.faulty = topic; return; }
      if (topic === "bridge/info") store.otherVersion = null;
      takeMessage(store, topic, payload);
    },
    /** Store the state of the recording, from a health message or from an answer that has just arrived. */
    takeRecording(state, t_us = gatewayNow(store)) {
      store.recording = { ...state, t_us, receivedMs: performance.now() };
      store.changed("recording");
    },
    /** Mark the state of the daemon as unknown, because the page lost its connection. */
    disconnected() {
      if (store.bridge === "lost") return;
      store.bridge = "lost";
      store.changed("bridge");
    },
    /** Wait for the retained messages again, because the daemon may have ended during the disconnection. */
    reconnected() {
      store.received.clear();
      Object.assign(store, { bridge: "unknown", otherVersion: null, faulty: null });
      store.changed("bridge");
    },
    /** Discard all data that may differ for another rig or another connection. */
    reset(base) {
      Object.assign(store, {
        base, bridge: "unknown", info: null, health: null, calibration: null, progress: null, recording: null,
        pose: null, poseReceivedMs: null, optical: null, opticalReceivedMs: null,
        sensors: null, sensorsReceivedMs: null, clock: null,
        events: [], poses: [], opticals: [], otherVersion: null, faulty: null,
      });
      store.received.clear();
      store.devices.clear();
      store.lastEvents.clear();
      for (const subject of listeners.keys()) store.changed(subject);
    },
  };
  return store;
}

function takeMessage(store, topic, payload) {
  switch (topic) {
    case "pose/ui":
      return takePose(store, payload);
    case "optical/pose":
      store.optical = payload;
      store.opticalReceivedMs = performance.now();
      store.opticals.push(payload);
      dropOld(store.opticals, payload.t_us);
      return undefined;
    case "sensors/pose":
      store.sensors = payload;
      store.sensorsReceivedMs = performance.now();
      return store.changed("sensors");
    case "bridge/state":
      store.bridge = payload?.state === "online" ? "online" : "offline";
      return store.changed("bridge");
    case "bridge/info":
      store.info = payload;
      return store.changed("info");
    case "bridge/health":
      store.health = payload;
      if (payload.recording) store.takeRecording(payload.recording, payload.t_us);
      return store.changed("health");
    case "calibration":
      return takeCalibration(store, payload);
    case "calibration/progress":
      store.progress = payload;
      return store.changed("calibration");
    case "bridge/event":
      return takeEvent(store, payload);
    default:
      return takeDevice(store, topic, payload);
  }
}

function takePose(store, pose) {
  const now = performance.now();
  // An older time means a restart of the daemon or a step of its clock, so the curve begins again.
  if (store.pose && pose.t_us < store.pose.t_us) {
    store.poses.length = 0;
    store.opticals.length = 0;
    store.clock = null;
  }
  store.pose = pose;
  store.poseReceivedMs = now;
  store.poses.push(pose);
  dropOld(store.poses, pose.t_us);
  noteClock(store, pose.t_us, now);
  store.changed("pose");
}

// The clocks of browser and gateway may differ by hours and drift. The smallest difference between
// receipt and time stamp in the last one or two windows converts browser time to gateway time.
function noteClock(store, t_us, nowMs) {
  const offsetMs = nowMs - t_us / 1000;
  if (store.clock === null) store.clock = { before: offsetMs, least: offsetMs, sinceMs: nowMs };
  const { clock } = store;
  if (nowMs - clock.sinceMs > CLOCK_WINDOW_MS) {
    Object.assign(clock, { before: clock.least, least: offsetMs, sinceMs: nowMs });
  }
  clock.least = Math.min(clock.least, offsetMs);
}

/** Return the current UNIX time of the gateway, µs; null if it is unknown. */
export function gatewayNow(store) {
  if (store.clock === null) return null;
  return (performance.now() - Math.min(store.clock.before, store.clock.least)) * 1000;
}

/** Return the current duration of the recording, s. */
export function recordingSeconds(store) {
  const { duration_s, t_us, receivedMs } = store.recording;
  const now_us = gatewayNow(store);
  const age_s = t_us !== null && now_us !== null ? (now_us - t_us) / 1e6 : (performance.now() - receivedMs) / 1000;
  return duration_s + Math.max(0, age_s);
}

/** Return the time since the last pose, ms; infinite without a pose. */
export const poseAgeMs = (store) => (store.poseReceivedMs === null ? Infinity : performance.now() - store.poseReceivedMs);

function dropOld(entries, newest_us) {
  const oldest_us = newest_us - (SHOWN_S + 1) * 1e6;
  let old = 0;
  while (old < entries.length && entries[old].t_us < oldest_us) old += 1;
  if (old > 0) entries.splice(0, old);
}

function takeCalibration(store, calibration) {
  store.calibration = calibration;
  if (calibration.phase !== store.progress?.phase) store.progress = null;
  store.changed("calibration");
}

function takeEvent(store, event) {
  store.events.unshift(event);
  store.events.length = Math.min(store.events.length, EVENTS);
  store.lastEvents.set(event.id, event);
  store.changed("events");
}

function takeDevice(store, topic, payload) {
  const found = /^device\/(.+)\/(availability|info)$/.exec(topic);
  if (!found) return;
  const device = store.devices.get(found[1]) ?? { availability: "unknown", info: null };
  if (found[2] === "availability") device.availability = payload?.state ?? "unknown";
  else device.info = payload;
  store.devices.set(found[1], device);
  store.changed("devices");
}

/** Return the displayed time range of the curves, s. */
export const shownSeconds = SHOWN_S;

/**
 * Return the value of a name in a payload; undefined if the payload lacks the name. Inherited properties are
 * excluded, because the name of a sensor may be a word such as "constructor".
 */
export function valueOf(table, name) {
  return table && Object.hasOwn(table, name) ? table[name] : undefined;
}
