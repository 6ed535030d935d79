// Start of the page: connects store, link and views.

import { createAccess } from "./access.js";
import { createActions } from "./actions.js";
import { chosenTitle, chosenValue, createAngleView, updateAngleAge } from "./angle_view.js";
import { createAnnouncer } from "./announcer.js";
import { createCalibrateView } from "./calibrate_view.js";
import { createDialogs } from "./dialogs.js";
import { byId, setText } from "./dom.js";
import { createHeader, pageState, updateEmptyState } from "./header.js";
import { createHistoryView } from "./history_view.js";
import { createLimbView, updateLimbCaption } from "./limb_view.js";
import { createLink } from "./link.js";
import { createLogView } from "./log_view.js";
import { createNotices } from "./notices.js";
import { createRecordingPanel } from "./recording_panel.js";
import { createRequests } from "./requests.js";
import { createSensorCards } from "./sensor_cards.js";
import { createSensorsView } from "./sensors_view.js";
import { createStore, gatewayNow } from "./store.js";
import { createTableView } from "./table_view.js";
import { connectTabs } from "./tabs.js";
import { formatNumber, isolate } from "./words.js";

const REFRESH_MS = 500;
const SEARCH_MS = 1200; // retained messages of rigs arrive within this time

async function readConfiguration() {
  const parameters = new URLSearchParams(location.search);
  const answer = await fetch("config.json", { cache: "no-store" }).catch(() => null);
  const server = answer?.ok ? await answer.json() : { version: "", broker: location.host, websocket: null, base: null };
  return { ...server, base: parameters.get("base") ?? server.base, remark: brokerRemark(parameters.get("broker"), server) };
}

// The server names the only broker to which its security policy permits connections. A link from
// another person must not make the page send a password to another broker.
function brokerRemark(wanted, server) {
  if (wanted === null || wanted === server.websocket) return "";
  const start = wanted.startsWith("wss://") || wanted.startsWith("ws://") ? wanted : "wss://HOST/PATH";
  return `The address of this page asks for the broker ${isolate(wanted)}, but its server is connected to ${server.broker}. To use another broker, start the server with --broker ${isolate(start)}.`;
}

async function start() {
  const configuration = await readConfiguration();
  const store = createStore();
  const rigs = new Map();
  let dialogs = null;

  const link = createLink(configuration, {
    changed: () => {
      if (link.state !== "connected") store.disconnected();
      refresh();
    },
    connected: () => store.reconnected(),
    message: (topic, payload) => {
      if (topic.startsWith("bridge/response/")) requests.answer(payload);
      else store.take(topic, payload);
    },
    found: (base, info) => { rigs.set(base, info); link.rigs = rigs.size; refresh(); },
    login: (reason) => dialogs.askForAccount(reason),
  });
  const requests = createRequests(link, () => gatewayNow(store) ?? Date.now() * 1000);
  dialogs = createDialogs(link, requests);
  const access = createAccess(link, store, requests);
  const updateNotices = createNotices(link, store, access, configuration);

  const choose = (base) => {
    store.reset(base);
    link.choose(base);
    refresh();
  };
  // Several rigs may use the same broker. If a short search finds only one rig, it is chosen.
  setInterval(() => { if (link.base === null && rigs.size === 1) choose(rigs.keys().next().value); }, SEARCH_MS);

  const limb = createLimbView(store);
  const angle = createAngleView(store);
  const updateCards = createSensorCards(store);
  const request = async (command, content) => {
    const data = await requests.ask(command, content, dialogs.askForKey);
    if (command === "record") store.takeRecording(data);
    return data;
  };
  const calibrate = createCalibrateView(store, request);
  const openAction = createActions(store, request, (name) => showView(name));
  const updateRecording = createRecordingPanel(store, access, request, openAction);
  const views = { history: createHistoryView(store, request), sensors: createSensorsView(store, link, openAction, request), log: createLogView(store, request), table: createTableView(store) };
  const updateHeader = createHeader(link, store, configuration, {
    reconnect: () => link.connect(),
    logIn: () => dialogs.askForAccount(link.reason),
    calibrate: () => showView("calibrate"),
    stop: () => calibrate.request({ phase: "abort" }),
  });
  const showView = connectTabs((name) => {
    limb.visible = angle.visible = name === "live";
    for (const [key, view] of Object.entries(views)) view.show(key === name);
  });

  const announce = createAnnouncer(byId("announcer"));
  function refresh() {
    access.update();
    updateHeader();
    updateNotices();
    updateEmptyState(link, store, configuration, rigs, choose);
    updateLimbCaption(store);
    updateAngleAge(angle);
    updateCards();
    updateRecording();
    announce(announcement(link, store, angle));
    setText(byId("versions"), [`jointfit ${configuration.version}`, store.info ? `jointfitd ${store.info.software}` : ""].filter(Boolean).join(" · "));
  }
  setInterval(refresh, REFRESH_MS);
  for (const subject of ["bridge", "info", "calibration"]) store.on(subject, refresh);
  store.on("pose", () => { if (byId("limb-panel").hidden) refresh(); });
  document.addEventListener("visibilitychange", () => { if (!document.hidden) refresh(); });

  // Values for measurements: messages, and main-thread time of drawing, ms.
  globalThis.jointfit = { store, link, limb, angle };
  if (configuration.base !== null) choose(configuration.base);
  link.connect();
}

/** Return the text for screen readers: a change of state, or the angle if the user has enabled it. */
function announcement(link, store, angle) {
  const { words, loss } = pageState(link, store);
  const state = loss ? `${words}. ${loss}` : words;
  if (!byId("announce-angle").checked || loss) return state;
  const [value, sd] = chosenValue(angle);
  if (value === null) return `${chosenTitle(angle)} unknown`;
  return `${chosenTitle(angle)} ${formatNumber(value, 0)} degrees${sd === null ? "" : `, plus or minus ${formatNumber(sd, 0)}`}`;
}

start();
