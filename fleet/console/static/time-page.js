// The time line: a lane for each car, live and of a recording. Scrubbing looks back: all pages show that moment then.

import { modeWords } from "./car-words.js";
import { carsInPlace, changed, clock, consoleNow, store, when, who } from "./console.js";
import { seen } from "./foreign.js";
import { LIVE_MS, useMoments } from "./moments.js";
import { goLive, jump, openSession } from "./past.js";
import { around, eventTimes, nearest, nextTime, placed, previousTime, recordingAt, saidAt, ticks, usedLanes } from "./spans.js";
import { t } from "./texts.js";
import { Component, html, useState } from "./ui.js";
import { lengthWords, momentOf } from "./when.js";

const LATE_MS = 2000; // the newest span ends with the last state, which is up to two seconds old
const NEAR_MS = 30_000;
const NEAR_AT_FIRST = 6;
const MAX_NEAR = 40;
const MAX_SESSIONS = 50;
const WINDOWS = [0, 600_000, 60_000]; // the whole, ten minutes, one

const WORDS_OF = { mode: modeWords, driver: (words) => t.drivenMark(who(words)), loss: (words) => t.timeLosses[words] ?? words };
const wordsOf = ({ lane, words }) => WORDS_OF[lane]?.(words) ?? words;
const sessionWords = (each) => `${when(each)}, ${lengthWords(each.length_s)}`;

// Drawn again only when its spans or the window have changed.
class CarLanes extends Component {
  shouldComponentUpdate(next) {
    return next.spans !== this.props.spans || next.from !== this.props.from || next.to !== this.props.to;
  }
  render({ car, spans, from, to }) {
    const shown = placed(spans.filter((each) => each.car === car), from, to);
    return html`<div class="lanes-of" aria-hidden="true">
      ${usedLanes(spans, car).map(
        (lane) => html`<div class=${`lane lane-${lane}`} key=${lane}>
          ${shown.filter((each) => each.lane === lane).map((each) => html`<span key=${each.begin} class=${each.bad ? "is-bad" : ""} data-mode=${lane === "mode" ? each.words : undefined}
            title=${wordsOf(each)} style=${{ left: `${100 * each.left}%`, width: `max(2px, ${100 * each.width}%)` }}>${wordsOf(each)}</span>`)}
        </div>`,
      )}
    </div>`;
  }
}

const Said = ({ spans }) =>
  spans.length === 0
    ? html`<span class="dim">${t.timeNothing}</span>`
    : spans.map((each, index) => html`<span class=${each.bad ? "bad" : "dim"} key=${each.lane}>${index > 0 && " · "}${each.bad ? "⚠ " : ""}${wordsOf(each)}</span>`);

export function TimePage() {
  const { sessions, running, readAgain, name, shown, at, whole, canScrub, go } = useMoments();
  const { past } = store;
  const [length, setLength] = useState(0);
  const [copied, setCopied] = useState("");
  const [typed, setTyped] = useState("");
  const [missing, setMissing] = useState(null); // the time of day that nothing covers: {words, nearest}
  const [isWhole, setWhole] = useState(false); // all that happened around the moment
  // A window around the moment, within the whole. It moves by halves, so that the lanes stand still under the finger.
  const step = length / 2;
  const from = length === 0 ? whole.from : Math.max(whole.from, Math.floor(at / step) * step - step / 2);
  const to = length === 0 ? whole.to : Math.max(from + 1000, Math.min(whole.to, from + length));
  const { spans = [], marks = [] } = shown ?? {};
  const cars = past === null ? carsInPlace().map((car) => car.name) : [...new Set([...(shown?.cars ?? []), ...past.cars.map((car) => car.name)])];

  const choose = async (event) => {
    const chosen = event.target.value;
    if (chosen === "") return goLive();
    const { begin } = await openSession(chosen);
    if (begin !== undefined) jump(chosen, begin);
    changed();
  };
  const goTo = async (event) => {
    event.preventDefault();
    const now = consoleNow();
    const at_ms = momentOf(typed, past?.at_ms ?? now, store.state.zone_s, now);
    setMissing(null);
    if (at_ms === null) return;
    if (name !== "" && at_ms >= whole.from && at_ms <= whole.to) return go(at_ms);
    const found = await readAgain();
    const recording = recordingAt(found.sessions, found.running, now, at_ms);
    if (recording !== undefined && recording.at === at_ms) return jump(recording.name, at_ms);
    setMissing({ words: t.timeNoRecording(clock(at_ms)), nearest: recording });
  };
  const press = (event) => {
    const box = event.currentTarget.getBoundingClientRect();
    go(from + ((event.clientX - box.left) / box.width) * (to - from));
  };
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(location.href);
      setCopied(t.linkCopied);
    } catch {
      setCopied(location.href); // plain http has no clipboard: it can be marked by hand
    }
  };
  const times = eventTimes(spans, marks);
  const button = (kind, words, label, to_ms) => html`<button data-go=${kind} aria-label=${label} title=${label} disabled=${!canScrub || to_ms === undefined} onClick=${() => go(to_ms)}>${words}</button>`;
  const near = around(spans, marks, at, NEAR_MS);
  const shownSessions = sessions.slice(0, MAX_SESSIONS);
  const named = (each) => (each.at_ms === null ? seen(each.name) : sessionWords(each));
  const unlisted = name && !shownSessions.some((each) => each.name === name) ? (shown?.begin ? when({ at_ms: shown.begin, zone_s: store.state.zone_s }) : seen(name)) : "";
  const listed = isWhole ? near.slice(0, MAX_NEAR) : nearest(near, at, NEAR_AT_FIRST);
  const isFromStart = past === null && whole.to - whole.from < LIVE_MS - 1000;
  return html`<div class="time-page">
    <div class="time-head">
      <h1>${t.time}</h1>
      <div class="controls">
        <label>${t.timeOf} <select name="session" value=${name} onChange=${choose}>
          <option value="">${t.timeNow}</option>
          ${shownSessions.map((each) => html`<option key=${each.name} value=${each.name}>${named(each)}${each.name === running ? ` (${t.timeRunning})` : ""}</option>`)}
          ${unlisted && html`<option value=${name}>${unlisted}</option>`}
        </select></label>
        <form class="controls" onSubmit=${goTo}>
          <input name="clock" aria-label=${t.timeClock} size="8" maxlength="8" inputmode="text" autocomplete="off" required pattern="\\s*\\d{1,2}[:.h ]?\\d{2}([:. ]?\\d{2})?\\s*" placeholder=${clock(whole.from, 5)} value=${typed} onInput=${(event) => setTyped(event.target.value)} />
          <button data-go="clock">${t.timeGo}</button>
        </form>
        <label>${t.timeWindow} <select name="window" value=${length} onChange=${(event) => setLength(Number(event.target.value))}>
          ${WINDOWS.map((each) => html`<option key=${each} value=${each}>${t.timeWindows[each]}</option>`)}
        </select></label>
      </div>
      <div role="status">${missing !== null && html`<p data-missing>${missing.words}${missing.nearest !== undefined && html` <button onClick=${() => {
        setMissing(null);
        jump(missing.nearest.name, missing.nearest.at);
      }}>${t.timeNearest(sessionWords(missing.nearest.session))}</button>`}</p>`}</div>
      ${past === null && html`<p class="hint" data-since>${(isFromStart ? t.timeSinceStart : t.timeSince)(clock(whole.from))} ${t.timeEarlier}</p>`}
      ${shown?.loading && shown.begin === undefined && html`<p role="status">${t.timeLoading}</p>`}
      ${shown?.words && html`<p class="bad">⚠ ${shown.words}</p>`}
      ${!canScrub && running !== null && html`<p class="hint">${t.timeUnrecorded}</p>`}
      <div class="controls time-steps" role="group" aria-label=${t.timeSteps}>
        ${button("previous", "|◀", t.timePrevious, previousTime(times, at))}
        ${button("back10", "−10 s", t.timeBack(10), at - 10_000)}${button("back1", "−1 s", t.timeBack(1), at - 1000)}
        ${button("on1", "+1 s", t.timeOn(1), at + 1000)}${button("on10", "+10 s", t.timeOn(10), at + 10_000)}
        ${button("next", "▶|", t.timeNext, nextTime(times, at))}
      </div>
    </div>
    <div class="time">
      <div class="time-scale"><time>${clock(from)}</time><strong data-moment=${at}>${clock(at, 10)}</strong><time>${clock(to)}</time></div>
      <input type="range" name="scrub" aria-label=${t.scrub} aria-valuetext=${clock(at, 10)} min=${from} max=${to} step="100" value=${at}
        disabled=${!canScrub} onInput=${(event) => go(event.target.valueAsNumber)} />
    </div>
    <section class="time-near"><h2>${t.timeAround(clock(at))}</h2>
      ${near.length === 0 && html`<p>${shown?.begin === undefined ? t.timeLoading : t.timeQuiet}</p>`}
      <ul class="plain">${listed.map(
        ([when, car, lane, words, bad], index) => html`<li key=${index}><button class="event" disabled=${!canScrub} onClick=${() => go(when)}>
          <time>${clock(when)}</time> <span class=${bad ? "bad" : ""}>${bad ? "⚠ " : ""}${car && html`<strong>${car}</strong>: `}${lane === "mark" ? html`<strong>⚑ ${words}</strong>` : wordsOf({ lane, words })}</span></button></li>`)}</ul>
      <div class="controls">
        ${near.length > listed.length && !isWhole && html`<button data-all-near onClick=${() => setWhole(true)}>${t.timeMore(near.length - listed.length)}</button>`}
        ${past !== null && html`<button data-link onClick=${copy}>${t.copyLink}</button><span role="status">${copied}</span>`}
      </div>
    </section>
    <div class="time-all">
      <div class="time-lanes" onPointerDown=${press}>
        <div class="time-ticks" aria-hidden="true">${ticks(from, to, store.state.zone_s).map((each) => html`<time key=${each} style=${{ left: `${(100 * (each - from)) / (to - from)}%` }}>${clock(each, to - from < 120_000 ? 8 : 5)}</time>`)}</div>
        <span class="cursor" style=${{ left: `${(100 * (Math.min(to, Math.max(from, at)) - from)) / (to - from)}%` }}></span>
        ${marks.filter(([when]) => when >= from && when <= to).map(([when, words], index) => html`<span class="mark" key=${index} title=${words} style=${{ left: `${(100 * (when - from)) / (to - from)}%` }}></span>`)}
        ${cars.map(
          (car) => html`<div class="time-car" key=${car} data-lanes=${car}>
            <p><strong>${car}</strong> <${Said} spans=${saidAt(spans, car, at, past === null ? LATE_MS : 0)} /></p>
            <${CarLanes} car=${car} spans=${spans} from=${from} to=${to} />
          </div>`,
        )}
      </div>
      <p class="hint">${t.timeLegend}</p>
    </div>
  </div>`;
}
