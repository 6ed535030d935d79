// Connection to the broker: finds a rig, subscribes, reconnects, and says which part is lost.

import mqtt from "../vendor/mqtt.esm.js";

const TOPICS = [
  "bridge/state", "bridge/info", "bridge/health", "bridge/event", "bridge/response/#",
  "calibration", "calibration/progress", "device/+/+", "pose/ui", "optical/pose",
];
const DISCOVERY = ["+/bridge/info", "+/+/bridge/info", "+/+/+/bridge/info", "+/+/+/+/bridge/info"];
const RECONNECT_MS = 1500;
const KEEPALIVE_S = 5;
// Close codes of the tunnel: the broker could not be reached, or closed the connection.
const BROKER_UNREACHABLE = 4502;
const BROKER_CLOSED = 4503;
const NOT_AUTHORISED = new Set([4, 5, 134, 135]);
const OTHER_VERSION = new Set([1, 132]);

/**
 * Return the link of the page to its broker.
 *
 * `configuration` is that of the server. `handlers` has `changed()` after every change of `state`,
 * `found(base)` for every rig, `message(topic, payload)` for every message of the chosen rig, and
 * `login(reason)` when the broker wants an account.
 */
export function createLink(configuration, handlers) {
  const link = {
    /** "connecting", "connected", "lost" or "refused". */
    state: "connecting",
    /** Reason in words, for "lost" and "refused". */
    reason: "",
    base: null,
    version: 5,
    account: {},
    client: null,
    closeCode: 0,
    closeReason: "",
    opened: false,
  };

  const change = (state, reason = "") => {
    if (link.state === state && link.reason === reason) return;
    Object.assign(link, { state, reason });
    handlers.changed();
  };

  link.connect = () => {
    link.client?.end(true);
    link.client = createClient(configuration, link, handlers, change);
  };
  link.logIn = (username, password) => {
    link.account = { username, password };
    link.connect();
  };
  link.choose = (base) => {
    if (link.base !== null) link.client?.unsubscribe(TOPICS.map((topic) => `${link.base}/${topic}`));
    link.base = base;
    if (link.client?.connected) subscribe(link);
  };
  link.subscribe = (topic) => link.client?.connected && link.client.subscribe(`${link.base}/${topic}`);
  link.unsubscribe = (topic) => link.client?.connected && link.client.unsubscribe(`${link.base}/${topic}`);
  link.publish = (topic, text, options) => link.client.publishAsync(`${link.base}/${topic}`, text, options);

  addEventListener("offline", () => change("lost", lossReason(link, configuration)));
  addEventListener("online", () => link.client?.reconnect());
  return link;
}

function createClient(configuration, link, handlers, change) {
  const own = new URL("mqtt", location.href);
  own.protocol = own.protocol.replace("http", "ws");
  const client = mqtt.connect(configuration.websocket ?? own.href, {
    ...link.account,
    protocolVersion: link.version,
    clientId: `jointfit-dashboard-${crypto.getRandomValues(new Uint32Array(2)).join("")}`,
    clean: true,
    keepalive: KEEPALIVE_S,
    reconnectPeriod: RECONNECT_MS,
    connectTimeout: 8000,
    resubscribe: false,
    timerVariant: "native", // workers from blobs are outside of the security policy
    createWebsocket: (url, protocols) => openWebSocket(url, protocols, link),
  });

  client.on("connect", () => {
    change("connected");
    subscribe(link);
  });
  client.on("close", () => {
    if (link.client === client && link.state !== "refused") {
      change("lost", lossReason(link, configuration));
    }
  });
  client.on("error", (error) => {
    if (OTHER_VERSION.has(error.code) && link.version === 5) {
      link.version = 4; // MQTT 3.1.1: the broker refused version 5
      link.connect();
    } else if (NOT_AUTHORISED.has(error.code)) {
      client.end(true);
      const user = link.account.username;
      const reason = user
        ? `The broker refuses the user name ${user} or its password.`
        : "The broker asks for a user name and a password.";
      change("refused", reason);
      handlers.login(reason);
    }
  });
  client.on("message", (topic, payload) => receive(link, handlers, topic, payload));
  return client;
}

// The close code of the tunnel distinguishes a lost broker from a lost server.
function openWebSocket(url, protocols, link) {
  const socket = new WebSocket(url, protocols);
  link.opened = false;
  socket.addEventListener("open", () => { link.opened = true; });
  socket.addEventListener("close", (event) => {
    link.closeCode = event.code;
    link.closeReason = event.reason;
  });
  return socket;
}

function lossReason(link, configuration) {
  const broker = configuration.broker;
  if (!navigator.onLine && !/^(localhost|127\.|\[::1\])/.test(location.host)) {
    return "This device has no network connection. The page continues when it is back.";
  }
  if (link.closeCode === BROKER_UNREACHABLE) return `No broker at ${broker}: ${link.closeReason}.`;
  if (link.closeCode === BROKER_CLOSED || link.opened) {
    return `The broker at ${broker} does not answer or closed the connection: check that it runs.`;
  }
  if (configuration.websocket) return `No connection to the broker at ${broker}: check that it runs, and the network.`;
  return `The dashboard server at ${location.host} does not answer: check that “jointfit dashboard” runs, and the network.`;
}

function subscribe(link) {
  if (link.base === null) link.client.subscribe(DISCOVERY, { qos: 0 });
  else link.client.subscribe(TOPICS.map((topic) => `${link.base}/${topic}`), { qos: 0 });
}

function receive(link, handlers, topic, bytes) {
  let payload;
  try {
    payload = JSON.parse(new TextDecoder().decode(bytes));
  } catch {
    return; // not a message of jointfitd
  }
  if (payload === null || typeof payload !== "object") return;
  if (link.base !== null && topic.startsWith(`${link.base}/`)) {
    handlers.message(topic.slice(link.base.length + 1), payload);
  } else if (topic.endsWith("/bridge/info") && payload.rig !== undefined) {
    handlers.found(topic.slice(0, -"/bridge/info".length), payload);
  }
}
