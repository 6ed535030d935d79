// Announcements to screen readers: at most one per second, and never the same text twice in succession.

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
