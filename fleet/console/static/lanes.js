// What the cars did lately, as the console tells it: spans of modes, drivers, holds, stops and losses.

import { on, unwish, wish } from "./console.js";
import { spanOf } from "./spans.js";

const KEPT_MS = 900_000; // as long as the console itself keeps them

const live = new Map();
on("lanes", ({ spans }) => {
  for (const each of spans) live.set(each.slice(0, 3).join(" "), spanOf(each));
  const newest = Math.max(...[...live.values()].map((each) => each.end));
  for (const [key, each] of live) if (each.end < newest - KEPT_MS) live.delete(key);
});
export const liveSpans = () => [...live.values()];

// Ask for the lanes while a page shows them. Return a function that ends this.
export function showLanes() {
  wish({ t: "lanes" });
  return () => unwish("lanes", { t: "lanes_end" });
}
