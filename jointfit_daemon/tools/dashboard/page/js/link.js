// Connection to the broker. It finds a rig, subscribes, reconnects, and reports what was lost.

import mqtt from "../vendor/mqtt.esm.js";

const TOPICS = [
  "bridge/state", "bridge/info", "bridge/health", "bridge/event", "bridge/response/#",
  "calibration", "calibration/progress", "device/+/+", "pose/ui", "optical/pose",
];
const DISCOVERY = ["+/bridge/info", "+/+/bridge/info", "+/+/+/bridge/info", "+/+/+/+/bridge/info"];
const RECONNECT_MS = 1500;
const SERVER_MS = 3000;
const INTERRUPTED = "The connection is interrupted. The page looks for the cause and connects again by itself.";
const KEEPALIVE_S = 5;
// Close codes of the tunnel: the broker could not be reached, or closed the connection.
const BROKER_UNREACHABLE = 4502;
const BROKER_CLOSED = 4503;
const NOT_AUTHORISED = new Set([4, 5, 134, 135]);
const OTHER_VERSION = new Set([1, 132]);

/**
 * Return the link of the page to its broker.
 *
 * `configuration` is from the server. `handlers` has callbacks: `changed()` after every change of `state`,
 * `connected()` after every connection, `found(base, info)` for every rig on the broker,
 * `message(topic, payload)` for every message of the chosen rig, and `login(reason)` if the broker requires
 * an account.
 */
export function createLink(configuration, handlers) {
  const link = {
    /** "connecting", "connected", "lost" or "refused". */
    state: "connecting",
    /** Reason as text, for "lost" and "refused". */
    reason: "",
    /** Browser time of the last change of `state`, ms. */
    sinceMs: 0,
    base: null,
    rigs: 0, // number of rigs on the broker
    version: 5,
    account: {},
    client: null,
    /** Topics that the broker refused in its answer to the subscription. */
    refused: new Set(),
    /** Topics that a view requested, in addition to the topics of every page. */
    wanted: new Set(),
    closeCode: 0,
    closeReason: "",
    opened: false,
  };

  const change = (state, reason = "") => {
    if (link.state === state && link.reason === reason) return;
    Object.assign(link, { state, reason, sinceMs: performance.now() });
    handlers.changed();
  };

  link.connect = () => {
    link.client?.end(true);
    const fault = addressFault(configuration.websocket);
    if (fault !== "") { change("lost", fault); return; }
    link.client = createClient(configuration, link, handlers, change);
  };
  link.logIn = (username, password) => {
    link.account = { username, password };
    link.connect();
  };
  link.choose = (base) => {
    if (link.base !== null) link.client?.unsubscribe(topicsOf(link));
    link.base = base;
    if (link.client?.connected) subscribe(link);
  };
  link.subscribe = (topic) => {
    link.wanted.add(topic); // subscribed again after each connection
    if (link.client?.connected && link.base !== null) link.client.subscribe(`${link.base}/${topic}`);
  };
  link.unsubscribe = (topic) => {
    link.wanted.delete(topic);
    if (link.client?.connected && link.base !== null) link.client.unsubscribe(`${link.base}/${topic}`);
  };
  link.publish = (topic, text, options) => link.client.publishAsync(`${link.base}/${topic}`, text, options);

  addEventListener("offline", () => change("lost", lossReason(link, configuration) ?? INTERRUPTED));
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
    timerVariant: "native", // the security policy forbids workers from blobs
    createWebsocket: (url, protocols) => openWebSocket(url, protocols, link),
  });

  client.on("connect", () => {
    handlers.connected();
    change("connected");
    subscribe(link);
  });
  client.on("close", async () => {
    const present = () => link.client === client && !client.connected && link.state !== "refused";
    if (!present()) return;
    const known = lossReason(link, configuration);
    if (known !== null || link.state !== "lost") change("lost", known ?? INTERRUPTED);
    if (known !== null) return;
    const reason = await serverReason(link, configuration);
    if (present()) change("lost", reason);
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
  Object.assign(link, { opened: false, closeCode: 0, closeReason: "" });
  socket.addEventListener("open", () => { link.opened = true; });
  socket.addEventListener("close", (event) => {
    link.closeCode = event.code;
    link.closeReason = event.reason;
  });
  return socket;
}

/** Return the reason of a loss; null if the server must be asked for the reason. */
function lossReason(link, configuration) {
  const { broker, websocket } = configuration;
  if (!navigator.onLine && !/^(localhost|127\.|\[::1\])/.test(location.host)) {
    return "This device has no network connection. The page continues when the network is back.";
  }
  if (link.closeCode === BROKER_UNREACHABLE) return `No connection to the broker at ${broker}: ${link.closeReason}.`;
  if (link.closeCode === BROKER_CLOSED) return `The broker at ${broker} ended the connection: ${link.closeReason}. Check that it runs.`;
  if (!websocket) return null;
  if (link.opened) return `The broker at ${broker} does not answer or closed the connection: check the broker and the network.`;
  return `No WebSocket at ${broker}: check that the broker runs, and that this is the port of its WebSocket listener, not its TCP port (often 1883). If the broker has no such listener, start the dashboard with --broker mqtt://HOST:PORT.`;
}

/** Return the cause of a loss, after a request that shows whether the server of the page answers. */
async function serverReason(link, configuration) {
  const opened = link.opened;
  const answer = await fetch("config.json", { cache: "no-store", signal: AbortSignal.timeout(SERVER_MS) }).catch(() => null);
  if (answer === null) {
    return `The dashboard server at ${location.host} does not answer: check that “jointfit dashboard” runs, and check the network.`;
  }
  if (!opened) {
    return `The dashboard server at ${location.host} accepts no WebSocket: too many pages are open, or a proxy on the way does not pass WebSockets on.`;
  }
  return `The broker at ${configuration.broker} does not answer: check that it runs.`;
}

/** Return the reason why a browser cannot connect to a broker address; empty if it can. */
function addressFault(websocket) {
  if (location.protocol !== "https:" || !websocket?.startsWith("ws:")) return "";
  return `Pages of https:// cannot connect to ${websocket}. Start the dashboard with --broker wss://HOST/PATH or mqtt://HOST:PORT.`;
}

const topicsOf = (link) => [...TOPICS, ...link.wanted].map((topic) => `${link.base}/${topic}`);

function subscribe(link) {
  link.refused.clear();
  const topics = link.base === null ? DISCOVERY : topicsOf(link);
  link.client.subscribe(topics, { qos: 0 }, (error, granted, packet) => {
    const codes = (packet ?? error?.packet)?.granted ?? [];
    topics.forEach((topic, i) => { if (codes[i] >= 128 && link.base !== null) link.refused.add(topic); });
  });
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
