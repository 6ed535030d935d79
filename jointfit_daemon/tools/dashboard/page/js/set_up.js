// The set-up page, which shows one question of the gateway and sends the answer. The gateway stores the
// state, so a reloaded page continues. Texts are set as text, never as HTML.
import { byId, createElement, setText } from "./dom.js";

const RETRY_MS = 2000;
let socket = null;
const FINDERS = {
  traffic: { text: "Find by its data", wait: "Receiving on the port …" },
  movement: {
    text: "Find by moving it",
    wait: "Hold all sensors still until this page asks you to turn one of them.",
  },
  identifiers: { text: "Find on the bus", wait: "Receiving for two seconds." },
  stream: { text: "Read the stream again", wait: "Asking the motion-capture system." },
};
let shown = null;
let finder = null;

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/set-up`, "jointfit-set-up");
  socket.addEventListener("open", () => send({ do: "show" }));
  socket.addEventListener("message", (event) => show(JSON.parse(event.data)));
  socket.addEventListener("close", () => {
    setText(byId("question-error"), "The gateway does not answer. Start the page on the gateway with: jointfit dashboard --set-up FOLDER");
    setTimeout(connect, RETRY_MS);
  });
}

function send(message) {
  if (socket.readyState !== WebSocket.OPEN) return;
  for (const button of byId("question-buttons").children) button.disabled = true;
  if (message.do === "find") setText(byId("question-help"), FINDERS[finder].wait);
  socket.send(JSON.stringify(message));
}

function showNote(note) {
  byId("question-notes").append(createElement("li", { dir: "auto" }, note.trim()));
}

function show(state) {
  if (state.note !== undefined) return showNote(state.note);
  setText(byId("set-up-path"), state.path ?? "");
  setText(byId("question-error"), state.error ?? "");
  byId("question-notes").replaceChildren();
  for (const note of state.notes ?? []) showNote(note);
  showAnswers(state);
  const key = state.written ? "written" : (state.question?.name ?? "complete");
  if (state.written) showWritten(state.written);
  else if (state.question) showQuestion(state.question, state.answered.length);
  else showText(state);
  if (key !== shown && shown !== null) byId("question-text").focus();
  shown = key;
}

function showAnswers(state) {
  const { answered, total } = state;
  setText(byId("question-count"), state.question ? `Question ${answered.length + 1} of about ${total}` : `${answered.length} answers`);
  byId("question-progress").value = total ? answered.length / total : 0;
  byId("answers").replaceChildren(...answered.flatMap(({ text, value }) => [
    createElement("dt", { dir: "auto" }, text), createElement("dd", { dir: "auto" }, value || "none"),
  ]));
  byId("found").replaceChildren(...(state.found.length ? state.found : [{ address: "None. Connect the devices, or type their names.", text: "" }]).map(
    ({ address, text }) => createElement("li", {}, address, text ? createElement("span", { class: "about" }, text) : null)));
}

function button(text, act, kind = "button") {
  return createElement("button", { type: kind === "primary" ? "submit" : "button", class: `button ${kind}`, onclick: kind === "primary" ? null : act }, text);
}

function showQuestion(question, position) {
  finder = question.finder;
  setText(byId("question-text"), question.text);
  setText(byId("question-help"), question.help);
  const options = question.choices.map(({ value, text }) => createElement(
    "label", { class: "option" },
    createElement("input", { type: "radio", name: "choice", value, checked: value === question.default }),
    createElement("span", { dir: "auto" }, value, text ? createElement("span", { class: "about" }, text) : null),
  ));
  const isListed = question.choices.some(({ value }) => value === question.default);
  const postponed = options.length === 1; // the only option is "later", so the user usually types an answer
  const input = createElement("input", { id: "typed", type: "text", autocomplete: "off", spellcheck: "false", dir: "auto",
    value: isListed ? "" : question.default, placeholder: question.optional ? "empty: none" : null });
  const typed = createElement("label", { class: "typed" }, options.length && !postponed ? "Or type an answer" : "Answer", input);
  const list = createElement("fieldset", { "aria-labelledby": "question-text" }, ...options);
  // The last answer that was chosen or typed is sent.
  list.addEventListener("change", () => { input.value = ""; });
  input.addEventListener("input", () => { for (const radio of list.querySelectorAll("input")) radio.checked = false; });
  const parts = [...(options.length ? [list] : []), ...(question.closed ? [] : [typed])];
  byId("question-field").replaceChildren(...(postponed ? parts.reverse() : parts));
  byId("question-form").onsubmit = (event) => {
    event.preventDefault();
    const chosen = document.querySelector("input[name=choice]:checked")?.value;
    const text = document.getElementById("typed")?.value.trim();
    send({ do: "answer", value: text || chosen || "" });
  };
  byId("question-buttons").replaceChildren(
    ...(position ? [button("Back", () => send({ do: "back" }))] : []),
    ...(question.finder ? [button(FINDERS[question.finder].text, () => send({ do: "find" }))] : []),
    button("Next", null, "primary"));
}

function showText(state) {
  setText(byId("question-text"), "Check and write the file");
  setText(byId("question-help"), `The answers are complete. The file is ${state.path}.`);
  const password = state.password_file && createElement("label", { class: "typed" }, `Password for the broker, written to ${state.password_file}`,
    createElement("input", { id: "password", type: "password", autocomplete: "off" }));
  byId("question-field").replaceChildren(...[
    createElement("pre", { tabindex: "0", role: "region", "aria-label": "Content of rig.toml", dir: "auto" }, state.text), password].filter(Boolean));
  byId("question-form").onsubmit = (event) => {
    event.preventDefault();
    send({ do: "write", password: document.getElementById("password")?.value ?? "" });
  };
  byId("question-buttons").replaceChildren(
    button("Back", () => send({ do: "back" })),
    button("Download", () => download(state.text)),
    button("Write rig.toml", null, "primary"));
}

function download(text) {
  const url = URL.createObjectURL(new Blob([text], { type: "application/toml" }));
  createElement("a", { href: url, download: "rig.toml" }).click();
  URL.revokeObjectURL(url);
}

function showWritten(written) {
  setText(byId("question-text"), "The rig is written");
  const open = written.open.length > 0;
  setText(byId("question-help"), `${written.path} ${open ? "still lacks the values listed below" : "is valid"}. Continue in a terminal of the gateway:`);
  byId("question-field").replaceChildren(
    ...(open ? [createElement("ul", {}, ...written.open.map((place) => createElement("li", {}, place)))] : []),
    ...written.warnings.map((warning) => createElement("p", { class: "fault" }, `Warning: ${warning}`)),
    createElement("div", { class: "commands" }, ...Object.entries(written.next).map(
      ([command, use]) => createElement("p", {}, use, createElement("code", {}, command)))));
  byId("question-buttons").replaceChildren(createElement("a", { class: "button primary", href: "./" }, "Open the dashboard"));
}

connect();
