// What a map draws, from what the console says. Pure. Meters, x to the right and y up; a picture has y down.

const MARGIN_M = 0.4;
const STEP_M = 0.5; // the edge of the picture moves by this, so that it stands still while cars drive
const SHORTEST_M = 2;

// A place as the console sends it.
export const placeOf = ([x, y, yaw, frame, std, age_s]) => ({ x, y, yaw, frame, std, age_s, isTrue: frame === "" });

// The floors that have cars, those with the most first; that of a simulation before others.
export function floorsOf(places) {
  const counts = new Map();
  for (const { frame } of Object.values(places)) counts.set(frame, (counts.get(frame) ?? 0) + 1);
  return [...counts.keys()].sort((one, other) => counts.get(other) - counts.get(one) || one.localeCompare(other));
}

// The box around what is drawn, as [left, bottom, right, top]. It grows with `before`, and never shrinks by itself.
export function boxOf(points, before = null) {
  const all = before === null ? points : [...points, [before[0] + MARGIN_M, before[1] + MARGIN_M], [before[2] - MARGIN_M, before[3] - MARGIN_M]];
  if (all.length === 0) return [-SHORTEST_M / 2, -SHORTEST_M / 2, SHORTEST_M / 2, SHORTEST_M / 2];
  const [xs, ys] = [all.map(([x]) => x), all.map(([, y]) => y)];
  const edges = (values) => {
    const [low, high] = [values.reduce((one, other) => Math.min(one, other)), values.reduce((one, other) => Math.max(one, other))];
    const missing = Math.max(0, SHORTEST_M - (high - low)) / 2;
    return [low - missing - MARGIN_M, high + missing + MARGIN_M];
  };
  const [[left, right], [bottom, top]] = [edges(xs), edges(ys)];
  const box = [Math.floor(left / STEP_M) * STEP_M, Math.floor(bottom / STEP_M) * STEP_M, Math.ceil(right / STEP_M) * STEP_M, Math.ceil(top / STEP_M) * STEP_M];
  return before !== null && before[0] <= left && before[1] <= bottom && before[2] >= right && before[3] >= top ? before : box;
}

// All points of a floor that should be seen.
export function pointsOf(world, places, trails, frame) {
  const shown = Object.entries(places).filter(([, place]) => place.frame === frame);
  const points = shown.map(([, { x, y }]) => [x, y]);
  for (const [car] of shown) for (const [, x, y] of trails[car] ?? []) points.push([x, y]);
  if (frame === "" && world !== null) {
    for (const [x1, y1, x2, y2] of world.walls) points.push([x1, y1], [x2, y2]);
    points.push(...world.line, ...world.lamps.map(([, x, y]) => [x, y]), ...world.things.map(([, x, y]) => [x, y]));
  }
  return points;
}

// The trails with what is new, without what is too old.
const TRAIL_MS = 30_000;
export function grown(before, { whole, trails }, now_ms) {
  const found = {};
  for (const car of new Set([...Object.keys(whole ? {} : before), ...Object.keys(trails)])) {
    const points = [...(whole ? [] : (before[car] ?? [])), ...(trails[car] ?? [])].filter(([at]) => at > now_ms - TRAIL_MS);
    if (points.length > 0) found[car] = points;
  }
  return found;
}

// Degrees counter-clockwise from x, 0 to 359.
export const degrees = (yaw) => ((Math.round((yaw * 180) / Math.PI) % 360) + 360) % 360;
