// Times in words, as a person says them. Pure. `zone_s`: offset of the clock on the wall there, s.

const DAY_MS = 86_400_000;
const dayOf = (at_ms, zone_s) => Math.floor((at_ms + 1000 * zone_s) / DAY_MS);
const onWall = (at_ms, zone_s) => new Date(at_ms + 1000 * zone_s);

// HH:MM:SS, or fewer or more letters of HH:MM:SS.mmm.
export const clockAt = (at_ms, zone_s, letters = 8) => onWall(at_ms, zone_s).toISOString().slice(11, 11 + letters);

// "today", "yesterday", a weekday of the last six days, else a date: with the year if it is another one.
export function dayWords(at_ms, zone_s, now_ms, now_zone_s, { days, months, today, yesterday }) {
  const ago = dayOf(now_ms, now_zone_s) - dayOf(at_ms, zone_s);
  const then = onWall(at_ms, zone_s);
  if (ago === 0) return today;
  if (ago === 1) return yesterday;
  if (ago > 1 && ago < 7) return days[then.getUTCDay()];
  const date = `${then.getUTCDate()} ${months[then.getUTCMonth()]}`;
  return then.getUTCFullYear() === onWall(now_ms, now_zone_s).getUTCFullYear() ? date : `${date} ${then.getUTCFullYear()}`;
}

// "12 s", "35 min", "2 h 5 min".
export function lengthWords(s) {
  if (s < 59.5) return `${Math.round(s)} s`;
  const min = Math.round(s / 60);
  if (min < 60) return `${min} min`;
  return min % 60 === 0 ? `${min / 60} h` : `${Math.floor(min / 60)} h ${min % 60} min`;
}

// The newest moment, not after now, with this time of day on the clock of the wall; `at_ms`: a moment of the day that is
// meant. "14:05", "14:05:30", "1405". null: this is not a time of day.
const TIME_OF_DAY = /^\s*(\d{1,2})[:.h ]?(\d{2})(?:[:. ]?(\d{2}))?\s*$/;
export function momentOf(text, at_ms, zone_s, now_ms) {
  const found = TIME_OF_DAY.exec(text);
  if (found === null) return null;
  const [h, min, s] = found.slice(1).map((each) => Number(each ?? 0));
  if (h > 23 || min > 59 || s > 59) return null;
  const on_day = dayOf(at_ms, zone_s) * DAY_MS - 1000 * zone_s + 1000 * (3600 * h + 60 * min + s);
  return on_day > now_ms ? on_day - DAY_MS : on_day;
}
