// The moment that is shown, and how a page goes to another one: shared by what has a scrub bar.

import { ask, consoleNow, store } from "./console.js";
import { liveSpans, showLanes } from "./lanes.js";
import { jump, lanesOf, openSession } from "./past.js";
import { useEffect, useRef, useState } from "./ui.js";

export const LIVE_MS = 900_000;
const SHORTEST_MS = 60_000; // of a console that has just begun
const REFRESH_MS = 10_000; // the lanes of a recording that grows
const LIVE_GAP_MS = 1500; // nearer to the end than this is now

async function readSessions() {
  const [listed, recorder] = await Promise.all([ask("/sessions"), ask("/recording/status", "")]);
  return { sessions: listed.sessions ?? [], running: recorder.ok && recorder.state === "recording" ? recorder.session : "" };
}

// The recordings, and a function that reads and returns them again.
function useSessions() {
  const [found, setFound] = useState({ sessions: [], running: null });
  const isOver = useRef(false);
  const read = async () => {
    const answer = await readSessions();
    if (!isOver.current) setFound(answer);
    return answer;
  };
  useEffect(() => {
    read();
    return () => (isOver.current = true);
  }, []);
  return [found, read];
}

// The live spans change with each message. For the eye, a new array each second is enough.
let liveMade = { at: 0, begin: 0, spans: [] };
const liveNow = () => {
  const at = Math.floor(consoleNow() / 1000);
  if (liveMade.at !== at) {
    const spans = liveSpans();
    const first = spans.reduce((least, each) => Math.min(least, each.begin), at * 1000 - SHORTEST_MS);
    liveMade = { at, begin: Math.max(first, at * 1000 - LIVE_MS), spans };
  }
  return liveMade;
};

// What is shown, from when to when one can go, and `go`. `running`: the session that is being recorded; null: not known yet.
export function useMoments() {
  const [{ sessions, running }, readAgain] = useSessions();
  useEffect(showLanes, []);
  const { past } = store;
  const name = past?.session ?? "";
  const isRunning = name !== "" && name === running;
  useEffect(() => {
    if (name) openSession(name);
    if (!isRunning) return;
    const timer = setInterval(() => openSession(name, { again: true }), REFRESH_MS);
    return () => clearInterval(timer);
  }, [name, isRunning]);
  const live = liveNow();
  const shown = past === null ? { spans: live.spans, marks: [], begin: live.begin, end: live.at * 1000 } : lanesOf(name);
  const at = past?.at_ms ?? shown.end;
  const whole =
    shown?.begin === undefined
      ? { from: at - LIVE_MS, to: at }
      : { from: Math.min(shown.begin, at), to: Math.max(isRunning ? live.at * 1000 : shown.end, at, shown.begin + 1000) };
  const canScrub = name !== "" || Boolean(running);
  const go = (to_ms) => {
    const asked = Math.min(whole.to, Math.max(whole.from, to_ms));
    if (past === null && asked > whole.to - LIVE_GAP_MS) return;
    if (canScrub) jump(name || running, asked);
  };
  return { sessions, running, readAgain, name, shown, at, whole, canScrub, go };
}
