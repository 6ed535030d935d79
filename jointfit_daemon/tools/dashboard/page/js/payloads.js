// Version and structure of the payloads that the page reads (docs/mqtt.md).

/** Version of the payloads that this page reads. */
export const PAYLOAD_VERSION = 1;

const isTable = (value) => value !== null && typeof value === "object" && !Array.isArray(value);
const isTableOf = (value, isElement) => isTable(value) && Object.values(value).every(isElement);
const isNames = (value) => Array.isArray(value) && value.every((name) => typeof name === "string");
const isPose = (payload) =>
  Number.isFinite(payload.t_us) && isTableOf(payload.segments, isTable) && isTableOf(payload.joints, isTable);

const FORMS = new Map(Object.entries({
  "bridge/info": (payload) =>
    isNames(payload.joints) && isNames(payload.segments)
    && isTableOf(payload.sensors, isNames) && isTableOf(payload.devices, isTable),
  "bridge/health": (payload) => isTableOf(payload.devices, isTable),
  "bridge/event": (payload) => Number.isFinite(payload.t_us) && typeof payload.text === "string",
  "calibration": (payload) => typeof payload.phase === "string",
  "pose/ui": isPose,
  "optical/pose": isPose,
}));

/** Return whether a payload has the structure of its topic, as far as the page depends on it. */
export function hasForm(topic, payload) {
  return isTable(payload) && (FORMS.get(topic)?.(payload) ?? true);
}
