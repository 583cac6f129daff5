// What several held keys, buttons and sticks mean together. Pure.

const ARCS = { spin_left: "left", spin_right: "right", left: "left", right: "right" };
const BASES = ["forward", "back"];

// The motion of what is held, the oldest first. Forward and a turn are an arc. A car has no arc backward: there, and
// in all other cases, the newest wins.
export function motionOf(held) {
  const newest = held.at(-1) ?? null;
  const base = held.findLast((motion) => BASES.includes(motion));
  const turn = held.findLast((motion) => motion in ARCS);
  return base === "forward" && turn !== undefined ? ARCS[turn] : newest;
}
