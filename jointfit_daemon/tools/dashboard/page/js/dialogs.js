// Dialogs for the account of the broker and for the key that signs requests. The page stores neither.

import { byId, setText } from "./dom.js";

/** Connect the dialogs; return functions that open them. */
export function createDialogs(link, requests) {
  connect("login", "login-send", "login-cancel", () => {
    link.logIn(byId("login-user").value, byId("login-password").value);
    byId("login-password").value = "";
  });
  let entered = null;
  connect("key-dialog", "key-send", "key-cancel", () => {
    requests.key = byId("key-value").value;
    byId("key-value").value = "";
    entered?.resolve();
  });
  byId("key-dialog").addEventListener("close", () => {
    entered?.reject(new Error("The request was not sent: it needs the request key."));
  });
  return {
    askForAccount(reason) {
      setText(byId("login-reason"), reason);
      if (byId("login").open) return;
      byId("login").showModal();
      if (byId("login-user").value !== "") byId("login-password").focus(); // usually the password was wrong
    },
    /** Wait until a key is entered; throw an Error if the dialog is closed without a key. */
    askForKey() {
      byId("key-dialog").showModal();
      return new Promise((resolve, reject) => { entered = { resolve, reject }; });
    },
  };
}

function connect(id, send, cancel, onSend) {
  const dialog = byId(id);
  const accept = () => { onSend(); dialog.close(); };
  byId(send).addEventListener("click", accept);
  byId(cancel).addEventListener("click", () => dialog.close());
  dialog.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target instanceof HTMLInputElement) { event.preventDefault(); accept(); }
  });
}
