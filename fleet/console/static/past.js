// Looking back: the pages show a moment of a recording, until somebody presses Live. What was known then comes by HTTP.
// The moment is part of the address, so that it can be sent to somebody.

import { ask, changed, describe, release, showPast, store } from "./console.js";
import { spanOf } from "./spans.js";

const ROUTE_END = /\?.*$/s;
export const route = () => location.hash.replace(ROUTE_END, "");

// ---------------------------------------------------------------- the lanes of a recording

let opened = null; // {name, loading, spans, marks, begin, end, cars, words}: of only one recording at a time
export const lanesOf = (name) => (opened?.name === name ? opened : null);

export function openSession(name, { again = false } = {}) {
  if (opened?.name === name && !again && !opened.loading) return opened;
  if (opened?.name === name && opened.loading) return opened.coming;
  const mine = { ...(opened?.name === name ? opened : { spans: [], marks: [], cars: [], words: "" }), name, loading: true };
  opened = mine;
  mine.coming = read(name, mine);
  return mine.coming;
}

async function read(name, mine) {
  const found = await ask(`/past/${encodeURIComponent(name)}`);
  if (opened !== mine) return opened;
  opened = found.ok
    ? { name, loading: false, spans: found.spans.map(spanOf), marks: found.marks, begin: found.begin_ms, end: found.end_ms, cars: found.cars, words: found.words }
    : { ...mine, loading: false, words: found.words };
  changed();
  return opened;
}

// ---------------------------------------------------------------- a moment

let extras = { car: "", series: [], span_s: 0, map: false, plan: false }; // what the page shows beside the cars
const NOTHING = { cars: [], detail: null, samples: null, map: null, plan: null, shown: null, words: "" }; // not known yet
let isDirty = false;
let isLoading = false;

async function load() {
  isDirty = true;
  if (isLoading) return;
  isLoading = true;
  while (isDirty && store.past !== null) {
    isDirty = false;
    const asked = { ...extras, at_ms: store.past.at_ms };
    const { session } = store.past;
    const found = await ask(`/past/${encodeURIComponent(session)}/at`, JSON.stringify(asked));
    if (store.past?.session !== session) {
      isDirty = store.past !== null;
      continue;
    }
    const { cars = [], detail = null, samples = null, map = null, plan = null } = found.ok ? found : {};
    const known = { cars, detail, samples, map, plan };
    showPast({ ...store.past, ...known, shown: asked, words: found.words ?? "" });
  }
  isLoading = false;
}

// Show the moment of a recording. Whatever is held is let go first.
export function jump(session, at_ms) {
  release();
  const before = store.past?.session === session ? store.past : { ...NOTHING, session };
  showPast({ ...before, at_ms: Math.round(at_ms) });
  writeAddress();
  load();
}

export function goLive() {
  showPast(null);
  writeAddress();
}

// What a page needs of each moment beside the cars: all about one car, or the values before it.
export function need(more) {
  const before = JSON.stringify(extras);
  extras = { ...extras, ...more };
  if (store.past !== null && JSON.stringify(extras) !== before) load();
}

// ---------------------------------------------------------------- the address

const withMoment = (to) =>
  store.past === null ? to : `${to}?session=${encodeURIComponent(store.past.session)}&at=${new Date(store.past.at_ms).toISOString()}`;
export const linkTo = (session, at_ms) => `#/time?session=${encodeURIComponent(session)}${at_ms == null ? "" : `&at=${new Date(at_ms).toISOString()}`}`;

function writeAddress() {
  const hash = withMoment(route() || "#/");
  if (location.hash !== hash) history.replaceState(null, "", hash);
}

// Go where the address says. A tab leads to another view of the same moment.
async function readAddress() {
  const given = new URLSearchParams(ROUTE_END.exec(location.hash)?.[0] ?? "");
  const [session, at] = [given.get("session"), given.get("at")];
  if (session === null) {
    if (store.past !== null) writeAddress();
    return;
  }
  const at_ms = Date.parse(at ?? "");
  if (!Number.isNaN(at_ms)) {
    if (store.past?.session !== session || store.past.at_ms !== at_ms) jump(session, at_ms);
    return;
  }
  const { begin, words } = await openSession(session); // another session may have replaced this one meanwhile
  if (begin !== undefined) jump(session, begin);
  else showPast({ ...NOTHING, session, at_ms: 0, words: words || describe.unreachable });
}
window.addEventListener("hashchange", readAddress);
readAddress();
