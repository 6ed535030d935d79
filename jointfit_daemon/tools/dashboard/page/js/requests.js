// Requests to the daemon (docs/mqtt.md, "Requests"). They are signed if the rig requires it.

const ANSWER_MS = 10_000;
const NOT_AUTHORISED = 135;

/** Return an object that sends requests over a link; `now()` returns the gateway's UNIX time, µs. */
export function createRequests(link, now) {
  const waiting = new Map();
  const requests = {
    /** Key that signs requests; null before a key is entered. */
    key: null,

    /** Process an answer of the daemon. */
    answer(payload) {
      waiting.get(payload.transaction)?.(payload);
    },

    /**
     * Send a request; return the data of the answer. `askForKey` is called if the rig accepts signed
     * requests only. Throw an Error with a sentence, and with the `faults` of the answer, if the request
     * has no effect.
     */
    async ask(command, content, askForKey) {
      const answer = await requests.send(command, content);
      if (answer.status !== "error") return answer.data ?? {};
      if (!needsSignature(answer.error)) {
        const refusal = new Error(`jointfitd refuses: ${answer.error?.message ?? "no reason given"}`);
        throw Object.assign(refusal, { faults: answer.error?.faults ?? [] });
      }
      await askForKey();
      return requests.ask(command, content, askForKey);
    },

    /** Send a request; return the answer. Throw an Error with a sentence if no answer arrives. */
    async send(command, content) {
      if (!link.client?.connected) throw new Error("The page is not connected to the broker.");
      const transaction = crypto.getRandomValues(new Uint32Array(4)).join("-");
      const request = { ...content, transaction };
      const topic = `bridge/request/${command}`;
      if (requests.key !== null) await sign(requests.key, `${link.base}/${topic}`, request, now());

      const answered = waitForAnswer(waiting, transaction);
      try {
        const published = await link.publish(topic, JSON.stringify(request), { qos: 1 });
        if (published?.reasonCode === NOT_AUTHORISED) throw new Error(NO_RIGHT);
      } catch (error) {
        waiting.delete(transaction);
        answered.catch(() => undefined); // the time limit rejects `answered` later; the rejection is expected
        throw error.message === NO_RIGHT ? error : new Error(NO_RIGHT);
      }
      return answered;
    },
  };
  return requests;
}

const NO_RIGHT = "The broker refuses the request: this account may not publish requests. Log in as an operator.";

function waitForAnswer(waiting, transaction) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(() => {
      waiting.delete(transaction);
      reject(new Error(
        `jointfitd did not answer within ${ANSWER_MS / 1000} s. It is not running, or this account`
        + " may not send requests or read answers.",
      ));
    }, ANSWER_MS);
    waiting.set(transaction, (payload) => {
      clearTimeout(timer);
      waiting.delete(transaction);
      resolve(payload);
    });
  });
}

/** Add time, nonce and signature to a request: HMAC-SHA256 of topic, newline and sorted JSON. */
export async function sign(key, topic, request, t_us) {
  if (!globalThis.crypto?.subtle) {
    throw new Error("Browsers sign only on https:// pages and on localhost. Open the page there, or use jointfit calibrate.");
  }
  request.t_us = Math.round(t_us);
  request.nonce = [...crypto.getRandomValues(new Uint8Array(16))].map(hex).join("");
  const sorted = Object.fromEntries(Object.keys(request).sort().map((name) => [name, request[name]]));
  const text = new TextEncoder().encode(`${topic}\n${JSON.stringify(sorted)}`);
  const secret = await crypto.subtle.importKey(
    "raw", new TextEncoder().encode(key.trim()), { name: "HMAC", hash: "SHA-256" }, false, ["sign"],
  );
  const signature = await crypto.subtle.sign("HMAC", secret, text);
  request.signature = [...new Uint8Array(signature)].map(hex).join("");
}

const hex = (byte) => byte.toString(16).padStart(2, "0");

/** Return whether an error of the daemon means that a signature is missing or wrong. */
function needsSignature(error) {
  return /signed requests only|^signature:/.test(error?.message ?? "");
}
