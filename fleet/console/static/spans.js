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

// What began or ended around a moment, the oldest first: [at, car, words, bad].
export function around(spans, marks, at, near_ms) {
  const begun = spans.map((each) => [each.begin, each.car, each.lane, each.words, each.bad]);
  const marked = marks.map(([when, words, by]) => [when, "", "mark", by ? `${words} (${by})` : words, false]);
  return [...begun, ...marked].filter(([when]) => Math.abs(when - at) <= near_ms).sort((one, other) => one[0] - other[0]);
}
