// Conversion of numbers, ages and states to text. An unknown value is "–", never 0 and never an old value.

export const UNKNOWN = "–";

/** Return a number with fixed decimals and its unit; "–" if it is unknown. */
export function formatNumber(value, decimals = 1, unit = "") {
  if (typeof value !== "number" || !Number.isFinite(value)) return UNKNOWN;
  const text = value.toFixed(decimals).replace(/^-(0(?:\.0+)?)$/, "$1").replace("-", "−");
  return `${text}${unit}`;
}

/** Return a whole number with narrow spaces between groups of three digits, from 10 000 on. */
export function formatCount(value) {
  const text = formatNumber(value, 0);
  return text.length > 4 ? text.replace(/\B(?=(\d{3})+$)/g, "\u202f") : text;
}

/** Return a duration in the largest fitting unit. */
export function formatDuration(seconds) {
  if (!Number.isFinite(seconds)) return UNKNOWN;
  if (seconds < 90) return `${Math.max(0, Math.round(seconds))} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  if (seconds < 129600) return `${Math.round(seconds / 3600)} h`;
  return `${Math.round(seconds / 86400)} days`;
}

/** Return a time in the past as text in whole minutes, so the text does not change every second. */
export function ageInWords(seconds) {
  if (seconds < 60) return "just now";
  return seconds < 90 ? "1 min ago" : `${formatDuration(seconds)} ago`;
}

/** Return a delay, given in microseconds, as text in milliseconds, or in seconds from one second on. */
export function formatDelay(microseconds) {
  if (microseconds >= 1e6) return formatNumber(microseconds / 1e6, 2, " s");
  return formatNumber(microseconds == null ? null : microseconds / 1000, 1, " ms");
}

/** Return a duration in hours, minutes and seconds, such as "0:12:04". */
export function formatStopwatch(seconds) {
  if (!Number.isFinite(seconds)) return UNKNOWN;
  const whole = Math.max(0, Math.floor(seconds));
  const pad = (value) => String(value % 60).padStart(2, "0");
  return `${Math.floor(whole / 3600)}:${pad(Math.floor(whole / 60))}:${pad(whole)}`;
}

/** Return a size in MB or GB. */
export function formatBytes(bytes) {
  if (bytes >= 1e9) return formatNumber(bytes / 1e9, bytes < 1e11 ? 1 : 0, " GB");
  return formatNumber(bytes / 1e6, 1, " MB");
}

/** Return the time of day of a UNIX time in microseconds. */
export function formatClock(microseconds) {
  if (!Number.isFinite(microseconds)) return UNKNOWN;
  return new Date(microseconds / 1000).toLocaleTimeString([], { hour12: false });
}

/** Return a name for use within a sentence; its writing direction does not affect the sentence. */
export const isolate = (name) => (/^[ -~]*$/.test(name) ? name : `\u2068${name}\u2069`);

/** Return a name as a heading: "left_knee" becomes "Left knee". Other scripts remain unchanged. */
export function titleOf(name) {
  const words = String(name).replaceAll("_", " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}

/** Return the name of an angle from its key: "flexion_deg" becomes "flexion". */
export function angleName(key) {
  return key === "inner_deg" ? "inner angle" : key.replace(/_deg$/, "").replaceAll("_", " ");
}

const FLAGS = {
  uncalibrated: "Not calibrated: angles are unknown.",
  headings_from_static: "Headings come from the static pose: there was no align phase.",
  same_pose_assumed: "The static pose was recorded without cameras; the same pose as before is assumed.",
  stuck: "% repeats its value and is not used.",
  slipped: "% moved on the body and is not used.",
  pair_disagrees: "The two sensors of % contradict each other: check their straps.",
  heading_disagrees: "Magnetic disturbance at the %: angles are corrected, headings are uncertain.",
  heading_unseen: "The limb may have turned about the vertical; joint angles are not affected.",
  one_sensor: "Only one sensor of % contributes.",
  held: "No data from the sensors of %: the last orientation is held.",
  lost: "No data from the sensors of %.",
  untrained: "% is outside the movements of the calibration: its error may be larger than in the calibration.",
  extrapolating: "A sensor is late and was extrapolated.",
  origin_fixed: "The cameras do not see the first joint.",
  axis_vertical: "% uses the vertical as its axis: the calibration found no joint centre.",
  axis_from_shoulder: "Axes of % come from the shoulder alone: calibrate with elbow flexion.",
  facing_unknown: "The flexion axis is unknown; the subject is assumed to have faced the y axis of the world.",
  uncorrected: "Sensors are used without correction (procedure of the patent).",
  gimbal: "Gimbal lock: flexion and rotation cannot be separated.",
};
const MINOR = new Set(["extrapolating", "headings_from_static", "origin_fixed", "uncorrected"]);

/** Return the sentence that describes a flag of a pose; return an unknown flag unchanged. */
export function flagSentence(flag) {
  const [kind, name = ""] = flag.split(/:(.*)/s);
  return (FLAGS[kind] ?? flag).replace("%", () => isolate(name));
}

/** Return whether a flag requires no action. */
export const isMinorFlag = (flag) => MINOR.has(flag.split(":")[0]);

const PHASES = {
  uncalibrated: "Not calibrated",
  align: "Calibrating: turn the plate",
  aligned: "Sensors aligned; the static pose is next",
  static: "Calibrating: stand still",
  posed: "Static pose recorded; the movement is next",
  functional: "Calibrating: move every joint",
  fitting: "Calibrating: computing the result",
  aborted: "Calibration stopped",
};
const RUNNING = new Set(["align", "static", "functional", "fitting"]);

/** Return whether a calibration phase runs. */
export const isRunning = (phase) => RUNNING.has(phase);

/** Return the state of the calibration as text, at a UNIX time of the gateway, µs. */
export function calibrationSentence(calibration, now_us = null) {
  if (!calibration) return "Waiting for the calibration state";
  const { phase, version, text, kept, created_utc } = calibration;
  if (phase === "calibrated") {
    const age_s = now_us === null ? NaN : (now_us / 1000 - Date.parse(created_utc ?? "")) / 1000;
    const made = Number.isFinite(age_s) ? `, ${ageInWords(age_s)}` : "";
    const stored = version == null ? "not stored yet" : `version ${version}${made}`;
    return kept ? `Calibrated, ${stored}; the last result was rejected` : `Calibrated, ${stored}`;
  }
  if (phase === "aborted" && version != null) return `Calibrated, version ${version}; last step stopped`;
  if (phase === "posed" && version != null) return `Calibrated, version ${version}; static pose recorded`;
  if (phase === "aborted" && text && !text.startsWith("abort requested")) return `Calibration stopped: ${text}`;
  return PHASES[phase] ?? String(phase);
}

const CLOCKS = {
  settling: ["unknown", "settling"],
  direct: ["ok", "sync line"],
  echo: ["ok", "synchronised"],
  passive: ["ok", "fitted"],
  arrival: ["warning", "no device time"],
  stale: ["warning", "stale"],
};

/** Return level and text of the clock quality of a device. */
export function clockQuality(device) {
  const [level, words] = CLOCKS[device?.clock] ?? ["unknown", UNKNOWN];
  const sigma = device?.sigma_us;
  if (level !== "ok" || typeof sigma !== "number") return [level, words];
  // With non-breaking spaces, a narrow card begins a new line before the number, not within it.
  if (sigma > 2000) return ["warning", `${words}, ±\u00a0${formatNumber(sigma / 1000, 1, "\u00a0ms")}`];
  return [level, `${words}, ±\u00a0${formatNumber(sigma, 0, "\u00a0µs")}`];
}
