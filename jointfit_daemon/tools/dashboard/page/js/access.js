// Read and request permissions of the page's account. A broker does not report that an account may not
// read a topic: it grants the subscription, but sends no messages. The daemon publishes `bridge/state`
// after all other retained topics, so a topic that is missing some seconds later is hidden from the account.

const SETTLE_MS = 3000;
const CHECK_WITHIN_MS = 2000; // pages that reconnect together after a restart check one after another
const EXPECTED = ["bridge/info", "bridge/health", "calibration", "pose/ui"];

/** Return the observer of the permissions on a rig; `requests` is from requests.js. */
export function createAccess(link, store, requests) {
  const access = { link, store, checked: null, mayRequest: null, since: null };
  access.update = () => {
    const seen = link.state === "connected" && link.base !== null && store.received.size > 0;
    if (!seen) access.since = null;
    else access.since ??= performance.now();
    const account = JSON.stringify([link.base, link.account.username]);
    if (store.bridge === "online" && access.checked !== account) {
      Object.assign(access, { checked: account, mayRequest: null });
      setTimeout(() => check(access, requests), Math.random() * CHECK_WITHIN_MS);
    }
  };
  return access;
}

// The request for the newest calibration has no effect, and its answer shows that requests are permitted.
async function check(access, requests) {
  const account = access.checked;
  let may;
  try {
    await requests.send("calibrations", { count: 1 });
    may = true;
  } catch {
    if (access.store.bridge !== "online" || access.link.state !== "connected") {
      access.checked = null; // the connection was lost: check again
      return;
    }
    may = false;
  }
  if (access.checked === account) access.mayRequest = may;
}

/** Return the topics below the base that the account cannot read. */
export function hiddenTopics({ link, store, since }) {
  if (since === null || performance.now() - since < SETTLE_MS) return [];
  const refused = [...link.refused].map((topic) => topic.slice(link.base.length + 1));
  const missing = (topic) => !store.received.has(topic) && !refused.includes(topic);
  const hidden = [...refused];
  if (store.bridge === "unknown") hidden.push("bridge/state");
  // A daemon that is not running publishes no poses, and a new rig has no calibration.
  if (store.bridge === "online") hidden.push(...EXPECTED.filter(missing));
  const devices = Object.keys(store.info?.devices ?? {}).map((name) => `device/${name}/availability`);
  if (store.bridge === "online" && devices.length > 0 && devices.every(missing)) hidden.push("device/+/availability");
  return [...new Set(hidden)];
}
