// Dialogs: account of the broker, and the key that signs requests. Neither is stored.

import { byId, setText } from "./dom.js";

/** Connect the dialogs; return functions that open them. */
export function createDialogs(link, requests) {
  connect("login", "login-send", "login-cancel", () => {
    link.logIn(byId("login-user").value, byId("login-password").value);
    byId("login-password").value = "";
  });
  let resend = null;
  connect("key-dialog", "key-send", "key-cancel", () => {
    requests.key = byId("key-value").value;
    byId("key-value").value = "";
    resend?.();
  });
  return {
    askForAccount(reason) {
      setText(byId("login-reason"), reason);
      if (!byId("login").open) byId("login").showModal();
    },
    askForKey(send) {
      resend = send;
      byId("key-dialog").showModal();
    },
  };
}

function connect(id, send, cancel, onSend) {
  const dialog = byId(id);
  const accept = () => { dialog.close(); onSend(); };
  byId(send).addEventListener("click", accept);
  byId(cancel).addEventListener("click", () => dialog.close());
  dialog.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target instanceof HTMLInputElement) { event.preventDefault(); accept(); }
  });
}
