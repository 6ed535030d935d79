// Functions that create and change elements. Text from MQTT is set as text, never as HTML.

const MOST_COLUMNS = 6; // a table with more columns does not fit on a phone
const SVG = "http://www.w3.org/2000/svg";

/** Return an element with attributes and children; strings become text. */
export function createElement(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

/** Return an SVG element with attributes and children. */
export function createSvg(name, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

function fill(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "onclick") element.addEventListener("click", value);
    else if (value !== false && value != null) element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child != null));
  return element;
}

/** Return the element with this id. */
export const byId = (id) => document.getElementById(id);

/** Set the text of an element if it differs, because an equal text would restart a screen reader. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set the class of an element if it differs. */
export function setClass(element, name) {
  if (element.className !== name) element.className = name;
}

/** Return a table with a caption, a header row and rows of texts or elements. */
export function createTable(caption, columns, rows) {
  const wide = columns.length > MOST_COLUMNS;
  // On a phone, the rows of a wide table are blocks. The ARIA roles remain those of a table.
  const role = (name) => (wide ? { role: name } : {});
  const cell = (value, column, index) =>
    createElement(
      index === 0 ? "th" : "td",
      {
        scope: index === 0 ? "row" : null, class: column.text ? "text" : null, dir: "auto",
        "data-column": wide ? column.name : null, ...role(index === 0 ? "rowheader" : "cell"),
      },
      value instanceof Node ? value : String(value),
    );
  return createElement(
    "div", { class: wide ? "scroll wide" : "scroll", tabindex: "0", role: "region", "aria-label": caption },
    createElement(
      "table", role("table"),
      createElement("caption", {}, caption),
      createElement("thead", role("rowgroup"), createElement("tr", role("row"),
        ...columns.map((column) =>
          createElement("th", { scope: "col", class: column.text ? "text" : null, ...role("columnheader") }, column.name)))),
      createElement("tbody", role("rowgroup"),
        ...rows.map((row) => createElement("tr", role("row"),
          ...row.map((value, index) => cell(value, columns[index], index))))),
    ),
  );
}

/**
 * Show a table in `root`. If `root` already contains a table of the same shape, only different cells
 * change. The focus and the scroll position therefore remain.
 */
export function patchTable(root, fresh) {
  const [before, after] = [root, fresh].map((element) => [...element.querySelectorAll("th, td, caption")]);
  const same = before.length === after.length && before.every((cell, i) => cell.className === after[i].className && cell.tagName === after[i].tagName);
  if (!same || before.length === 0) {
    root.replaceChildren(fresh);
    return;
  }
  before.forEach((cell, i) => {
    if (cell.innerHTML !== after[i].innerHTML && !cell.contains(document.activeElement)) cell.replaceChildren(...after[i].childNodes);
  });
}
