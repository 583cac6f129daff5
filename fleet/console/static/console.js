// The page's side of the one WebSocket: the newest state, presses, STOP, commands and their outcomes.

import { parse, seen } from "./foreign.js";
import { motionOf } from "./held-motion.js";
import { placed } from "./places.js";
import { clockAt, dayWords } from "./when.js";

const RECONNECT_MS = 500;
const NOT_PAIRED = 4001; // the close code of a page whose device was revoked, or whose pairing has expired
const SENT_TOO_MUCH = 4008; // the close code of a page that has sent far more than a person can
const COOLDOWN_MS = 15_000;
const UNPAIRED_MS = 5000;
const MAX_WHY = 200; // letters of a refusal that are shown
const LOST_MS = 1500;
const MAX_RESULTS = 6;
const DRAWING_SHARE = 3; // the page rests three times as long as a drawing took
const MAX_DRAWING_MS = 150; // the longest time that counts, so that the page rests 450 ms at most
const STOPS = ["stop", "estop"]; // also while somebody looks back
const STOP_RETRY_MS = 10_000; // the maximum age of a stop when it arrives at a gateway

// A page that is loaded again (phones do that with a page that slept) has the same cars selected. Each tab has its own.
const SELECTED = "fleet-selected";
function remembered() {
  try {
    const names = JSON.parse(sessionStorage.getItem(SELECTED));
    return Array.isArray(names) ? names.filter((name) => typeof name === "string") : [];
  } catch {
    return []; // a browser that keeps nothing
  }
}

const listeners = new Set();
export const store = {
  state: null,
  rights: null, // what this person may not do: words by car and action; `mine`: the cars of this person
  groups: {}, // the names of cars by group
  past: null, // the moment that is looked at: {session, at_ms, cars, ...} (past.js); null: now
  places: [], // the name of the car at each place
  hello: null,
  connected: false,
  lost: false,
  silent_s: 0, // whole seconds since the console said anything, while it is lost
  stopUnsent: false, // the last STOP has not reached the console
  refusedWhy: "", // why the console does not let this page in, in its own words
  unpaired: "", // "revoked": not even STOP works. "expired": STOP by fetch works
  press: null, // the motion that is driven: {id, motion, cars}
  results: [],
  selected: new Set(remembered()), // the names of the cars to drive
};

export function select(names) {
  store.selected = new Set(names);
  try {
    sessionStorage.setItem(SELECTED, JSON.stringify([...store.selected]));
  } catch {}
}

let socket = null;
let tick = 0;
let pressNumber = 0;
let requestNumber = 0;
let lastMessageAt = performance.now();
let stateAt = 0;
let drawing = false;
const verbs = new Map();

export function subscribe(listener) {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

export function changed() {
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(() => {
    drawing = false;
    const began = performance.now();
    for (const listener of listeners) listener();
    // Measure after the frame: on a slow phone its layout and paint take longest.
    setTimeout(() => {
      const now = performance.now();
      freeAt = now + DRAWING_SHARE * Math.min(now - began, MAX_DRAWING_MS);
    });
  });
}

// A new state is drawn when the page is free for it: a slow phone must stay free for the finger.
let freeAt = 0;
let drawsLater = false;
function stateChanged() {
  const wait = freeAt - performance.now();
  if (drawsLater) return;
  if (wait <= 0) {
    changed();
    return;
  }
  drawsLater = true;
  setTimeout(() => {
    drawsLater = false;
    changed();
  }, wait);
}

function send(message) {
  if (socket !== null && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function note(words, bad) {
  store.results = [{ key: ++requestNumber, words, bad }, ...store.results].slice(0, MAX_RESULTS);
  changed();
}

// ---------------------------------------------------------------- time

// The clock of this device may be wrong, and its zone another one: all times are those of the console.
export const consoleNow = () => (store.state?.at_ms ?? 0) + performance.now() - stateAt;

// The time of day at the console: HH:MM:SS, or fewer or more letters of HH:MM:SS.mmm.
export const clock = (at_ms, letters = 8) => clockAt(at_ms, store.state?.zone_s ?? 0, letters);

// When something was, as a person says it: "today 00:46".
export const when = ({ at_ms, zone_s }, letters = 5) =>
  `${dayWords(at_ms, zone_s, consoleNow(), store.state?.zone_s ?? 0, describe.calendar)} ${clockAt(at_ms, zone_s, letters)}`;

// ---------------------------------------------------------------- STOP

const newId = () => Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");

// Send STOP in two ways: the socket may be half dead, and a fetch with keepalive outlives the page. The console acts once.
export function stopAll() {
  const id = newId();
  send({ t: "stop", id });
  postStop(id, performance.now() + STOP_RETRY_MS);
  letGo();
  changed();
}

let newestStop = "";
async function postStop(id, until) {
  newestStop = id;
  for (;;) {
    let reached = false;
    try {
      reached = (await fetch(`/stop?id=${id}`, { method: "POST", keepalive: true })).ok;
    } catch {}
    if (newestStop !== id) return; // a later press says how it went
    reached ||= store.connected && !store.lost; // by the socket
    store.stopUnsent = !reached;
    changed();
    if (reached || performance.now() > until) return;
    await new Promise((resume) => setTimeout(resume, RECONNECT_MS));
  }
}

export function estopAll(why) {
  if (!store.connected || store.lost) stopAll(); // a stop also goes by fetch, again and again
  stopFor("estop", why);
}

export const pauseAll = (why) => stopFor("pause", why);

// An e-stop or a pause goes over the socket. If that breaks before the console has begun the stop, the next socket gets
// the message again. The console acts once.
let latched = null; // {message, at_ms, until}: the newest one, until the console has begun it
function stopFor(t, why) {
  latched = { message: { t, id: newId(), why }, at_ms: consoleNow(), until: performance.now() + STOP_RETRY_MS };
  send(latched.message);
  letGo();
  changed();
}

function sendLatched() {
  if (latched !== null && performance.now() < latched.until) send(latched.message);
}

function noteLatched({ stop }) {
  if (latched !== null && stop?.verb === latched.message.t && stop.at_ms >= latched.at_ms) latched = null;
}

// "estop" or "pause": somebody has pressed it, and it has not reached the console. Else empty.
export const unsentStop = () => (latched !== null && (!store.connected || store.lost || performance.now() > latched.until) ? latched.message.t : "");

// ---------------------------------------------------------------- who may do what

// The person of a sender, without host and process. A sender without a person stays as it is.
const personOf = (sender) => seen(sender.split("@")[0] || sender);
export const who = (sender) => (sender === store.hello?.sender ? describe.you : personOf(sender));

// ---------------------------------------------------------------- the past

// While somebody looks back, nothing is commanded but stops: what one sees is not what would be commanded.
let rightsNow = null;
function applyRights() {
  const refused = store.past === null ? {} : { manage: describe.pastRefused, unpause: describe.pastRefused };
  store.rights = rightsNow && { ...rightsNow, ...refused };
}

// Show a moment of a recording; null: now. What is held is let go.
export function showPast(past) {
  if ((past === null) !== (store.past === null)) release();
  store.past = past;
  applyRights();
  changed();
}

// The cars that are shown, the time that is shown, and how long nothing came, s.
export const shownCars = () => store.past?.cars ?? store.state?.cars ?? [];
export const shownNow = () => store.past?.at_ms ?? consoleNow();
export const unheard_s = () => (store.past === null ? store.silent_s : 0);

// Why cars refuse an action of this person, each once. The gateways decide; the page says it before.
const refusal = (action, car) => store.rights?.cars[car]?.[action];
export function refusals(action, cars) {
  if (store.past !== null) return [describe.pastRefused];
  return [...new Set(cars.map((car) => refusal(action, car)).filter(Boolean))];
}
export const isRefused = (action, cars) => store.past !== null || (cars.length > 0 && cars.every((car) => refusal(action, car)));

// The cars that the fleet file or a loan gives to this person, whatever else keeps them from driving now.
export const isMine = (car) => store.rights.mine.includes(car);
export const isShared = (names) => names.some(isMine) && !names.every(isMine);

// Sets of cars with the names that a person gives them: all, mine, and each group. `members` may name cars that are not there.
export function carSets(cars) {
  const names = cars.map((car) => car.name);
  const sets = [{ key: "all", name: describe.allCars, members: names }];
  if (isShared(names)) sets.push({ key: "mine", name: describe.mine, members: store.rights.mine });
  for (const [name, members] of Object.entries(store.groups)) sets.push({ key: `@${name}`, name: `@${name}`, members });
  return sets
    .map((set) => ({ ...set, cars: names.filter((name) => set.members.includes(name)) }))
    .filter((set) => set.key === "all" || set.cars.length > 0);
}

// Nothing is drawn before all three are there: the rights say whose cars come first.
export const isReady = () => store.hello !== null && store.state !== null && store.rights !== null;

// The cars in the order of their places.
export function carsInPlace() {
  const cars = new Map(shownCars().map((car) => [car.name, car]));
  store.places = placed(store.places, [...cars.keys()], isShared([...cars.keys()]) ? isMine : () => false);
  return store.places.filter((name) => cars.has(name)).map((name) => cars.get(name));
}

export function unpause() {
  if (store.past !== null) return;
  verbs.set(++requestNumber, "unpause");
  send({ t: "unpause", id: requestNumber, n: tick });
}

// ---------------------------------------------------------------- hold to drive

// Keys, buttons and fingers that are down, the oldest first: {source, motion}. When a drive ends for any other reason
// than their release, none of them counts any more: whoever wants to drive on presses again.
let holds = [];

function letGo() {
  holds = [];
  store.press = null;
}

export const isHeld = (source) => holds.some((each) => each.source === source);

export function press(motion, cars, source) {
  if (store.past !== null) return;
  holds = [...holds.filter((each) => each.source !== source), { source, motion }];
  drive(cars);
}

function drive(cars) {
  const motion = motionOf(holds.map((each) => each.motion));
  if (store.press?.motion === motion) return;
  if (cars.length === 0 || isRefused("move", cars) || !store.connected || document.visibilityState !== "visible") {
    release();
    return;
  }
  store.press = { id: ++pressNumber, motion, cars };
  send({ t: "press", press: pressNumber, cars, motion, n: tick });
  changed();
}

// Release this source (left out: all). What is still held drives on.
export function release(source) {
  if (source !== undefined) {
    if (!isHeld(source)) return;
    holds = holds.filter((each) => each.source !== source);
    if (holds.length > 0 && store.press !== null) {
      drive(store.press.cars);
      return;
    }
  }
  if (store.press !== null) send({ t: "release", press: store.press.id });
  letGo();
  changed();
}

for (const name of ["blur", "pagehide"]) window.addEventListener(name, () => release());
document.addEventListener("freeze", () => release());
document.addEventListener("visibilitychange", () => {
  if (document.visibilityState !== "visible") release();
});

// ---------------------------------------------------------------- commands

// Each command names the newest tick. By it the console knows how old the command is when a slow link has delivered it.
export function command(verb, cars, fields = {}) {
  if (cars.length === 0 || (store.past !== null && !STOPS.includes(verb))) return;
  verbs.set(++requestNumber, verb);
  send({ t: "do", id: requestNumber, n: tick, verb, cars, ...fields });
}

export function lease(kind, cars) {
  if (store.past !== null) return;
  verbs.set(++requestNumber, kind === "take" ? "lease" : "release");
  send({ t: kind, id: requestNumber, n: tick, cars });
}

// What pages show beside the cars: a page registers a handler for messages of the console with this `t`. The page is
// drawn again afterwards, unless the handler returns false.
const handlers = new Map();
export function on(kind, handler) {
  handlers.set(kind, handler);
}

export function askBySocket(kind, fields) {
  send({ t: kind, id: ++requestNumber, n: tick, ...fields });
  return requestNumber;
}

// What a page wants from now on, also of a console that was started again. `end` is sent when the wish ends.
const wishes = new Map();
export function wish(message) {
  wishes.set(message.t, message);
  send(message);
}
export function unwish(kind, end) {
  wishes.delete(kind);
  send(end);
}

async function request(path, body) {
  const response = await fetch(path, body === undefined ? {} : { method: "POST", body });
  return parse(await response.text());
}

// Ask the console by HTTP for what is not about driving. Always answers with an object.
export async function ask(path, body) {
  try {
    return await request(path, body);
  } catch {
    return { ok: false, words: describe.unreachable };
  }
}

// ---------------------------------------------------------------- the socket

export let describe = { done: () => "", refused: () => "", modes: {} };
export function setTexts(texts) {
  describe = texts;
}

function onMessage(text) {
  lastMessageAt = performance.now();
  const message = parse(text);
  switch (message.t) {
    case "tick":
      tick = message.n;
      if (store.press !== null) send({ t: "echo", n: tick, press: store.press.id });
      for (const listener of tickListeners) listener();
      return;
    case "state":
      store.state = message;
      stateAt = lastMessageAt;
      noteLatched(message);
      stateChanged();
      return;
    case "rights":
      rightsNow = message;
      applyRights();
      break;
    case "groups":
      store.groups = message.groups;
      break;
    case "hello":
      store.hello = message;
      Object.assign(describe.modes, message.modes);
      break;
    case "over":
      if (store.press !== null && store.press.id === message.press) {
        letGo();
        note(message.words, true);
      }
      break;
    case "refused":
      note(describe.refused(message.outcome), true);
      break;
    case "done": {
      const verb = verbs.get(message.id);
      verbs.delete(message.id);
      for (const outcome of message.outcomes) {
        note(outcome.ok ? describe.done(verb, outcome) : describe.refused(outcome), !outcome.ok);
      }
      break;
    }
    case "bad":
      if (latched?.message.t === "pause") latched = null; // it may have been refused
      note(message.words, true);
      break;
    default:
      if (handlers.get(message.t)?.(message) === false) return;
  }
  changed();
}

export const newestTick = () => tick;
const tickListeners = new Set();
export function onTick(listener) {
  tickListeners.add(listener);
  return () => tickListeners.delete(listener);
}

async function connect() {
  // A console that was started again needs another cookie, which this request brings.
  try {
    const hello = await fetch("/hello");
    const why = hello.ok ? "" : seen((await hello.text()).slice(0, MAX_WHY));
    store.unpaired = hello.status !== 403 ? "" : why.includes("expired") ? "expired" : "revoked";
    if (why) store.refusedWhy = why;
  } catch {
    store.refusedWhy = "";
    setTimeout(connect, RECONNECT_MS);
    return;
  }
  if (store.unpaired) {
    changed();
    setTimeout(connect, UNPAIRED_MS);
    return;
  }
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
  socket.onopen = () => {
    store.connected = true;
    store.refusedWhy = "";
    pressNumber = 0;
    sendLatched();
    for (const message of wishes.values()) send(message);
    changed();
  };
  socket.onmessage = (event) => onMessage(event.data);
  socket.onclose = (event) => {
    store.connected = false;
    letGo();
    store.refusedWhy = seen(event.reason);
    if (event.code === SENT_TOO_MUCH) note(event.reason, true);
    if (event.code === NOT_PAIRED) store.unpaired = "revoked"; // `/hello` knows better in a moment
    changed();
    const wait = { [SENT_TOO_MUCH]: COOLDOWN_MS, [NOT_PAIRED]: 0 };
    setTimeout(connect, wait[event.code] ?? RECONNECT_MS);
  };
}

setInterval(() => {
  const silent_ms = performance.now() - lastMessageAt;
  const lost = silent_ms > LOST_MS;
  const silent_s = lost ? Math.floor(silent_ms / 1000) : 0;
  if (lost !== store.lost || silent_s !== store.silent_s) {
    store.lost = lost;
    store.silent_s = silent_s;
    if (lost) letGo();
    changed();
  }
}, 250);

connect();
