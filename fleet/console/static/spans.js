// Spans of the lanes of a time line. Pure. Times: ms.

export const LANES = ["mode", "driver", "hold", "stop", "loss"];

// As the console sends one: {car, lane, begin, end, words, bad}.
export const spanOf = ([car, lane, begin, end, words, bad]) => ({ car, lane, begin, end, words, bad });

// The spans in a window, as shares of it. Of too many the longest stay: the others would be thinner than a pixel.
const MOST = 1200;
export function placed(spans, from, to) {
  const shown = spans.filter((each) => each.end >= from && each.begin <= to);
  if (shown.length > MOST) shown.sort((one, other) => other.end - other.begin - (one.end - one.begin)).splice(MOST);
  const share = (at) => Math.min(1, Math.max(0, (at - from) / (to - from)));
  return shown.map((each) => ({ ...each, left: share(each.begin), width: share(each.end) - share(each.begin) }));
}

// When something begins that is worth a look: all but modes and drivers that go on, and the marks.
export const eventTimes = (spans, marks) =>
  [...new Set([...spans.map((each) => each.begin), ...marks.map(([at]) => at)])].sort((one, other) => one - other);

const EVENT_GAP_MS = 50; // what begins together is one event
export const nextTime = (times, at) => times.find((each) => each > at + EVENT_GAP_MS);
export const previousTime = (times, at) => times.findLast((each) => each < at - EVENT_GAP_MS);

// What each lane of a car says at a moment.
export const saidAt = (spans, car, at, late_ms = 0) =>
  LANES.map((lane) => spans.findLast((each) => each.car === car && each.lane === lane && each.begin <= at && at <= each.end + late_ms)).filter(Boolean);

// What began around a moment, the oldest first: [at, car, lane, words, bad]. Presses of one person soon after each
// other count as one.
const DRIVES_ON_MS = 15_000;
export function around(spans, marks, at, near_ms) {
  const isNear = ([when]) => Math.abs(when - at) <= near_ms;
  const drives = spans.filter((each) => each.lane === "driver");
  const goesOn = (span) =>
    span.lane === "driver" &&
    drives.some((each) => each.car === span.car && each.words === span.words && each.begin < span.begin && each.end > span.begin - DRIVES_ON_MS && Math.abs(each.begin - at) <= near_ms);
  const begun = spans.filter((each) => isNear([each.begin]) && !goesOn(each)).map((each) => [each.begin, each.car, each.lane, each.words, each.bad]);
  const marked = marks.map(([when, words, by]) => [when, "", "mark", by ? `${words} (${by})` : words, false]).filter(isNear);
  return [...begun, ...marked].sort((one, other) => one[0] - other[0]);
}

// The nearest of them, in the order of their times.
export const nearest = (events, at, count) =>
  [...events].sort((one, other) => Math.abs(one[0] - at) - Math.abs(other[0] - at)).slice(0, count).sort((one, other) => one[0] - other[0]);

// The lanes that a car has anything in.
export const usedLanes = (spans, car) => {
  const used = new Set(spans.filter((each) => each.car === car).map((each) => each.lane));
  return LANES.filter((lane) => used.has(lane));
};

// The recording that covers a moment; and if none does, the nearest one with the moment of it that is nearest.
export function recordingAt(sessions, running, now, at) {
  const known = sessions
    .filter((each) => each.at_ms !== null)
    .map((each) => ({ name: each.name, begin: each.at_ms, end: each.name === running ? now : each.at_ms + 1000 * (each.length_s ?? 0), session: each }))
    .map((each) => ({ ...each, at: Math.min(each.end, Math.max(each.begin, at)) }));
  return known.sort((one, other) => Math.abs(one.at - at) - Math.abs(other.at - at))[0];
}

// Round times of the clock on the wall in a window, few enough for a phone.
const STEPS_S = [5, 10, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14_400, 43_200, 86_400];
const MOST_TICKS = 5;
export function ticks(from, to, zone_s) {
  const step = 1000 * (STEPS_S.find((each) => (to - from) / (1000 * each) <= MOST_TICKS) ?? STEPS_S.at(-1));
  const first = Math.ceil((from + 1000 * zone_s) / step) * step - 1000 * zone_s;
  return Array.from({ length: Math.max(0, Math.floor((to - first) / step) + 1) }, (_, index) => first + index * step).slice(0, 100);
}
