// The only live region of the page. It shows at most one text per second, and never the same text twice.

const INTERVAL_MS = 1000;

/** Return a function that announces a text to screen readers. */
export function createAnnouncer(region) {
  let next = null;
  let last = "";
  setInterval(() => {
    if (next === null || next === last) return;
    last = next;
    next = null;
    region.textContent = last;
  }, INTERVAL_MS);
  return (text) => { next = text; };
}
