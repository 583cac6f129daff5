// The time line: a lane for each car, live and of a recording. Who scrubs looks back: all pages show that moment then.

import { carsInPlace, changed, clock, store, when, who } from "./console.js";
import { seen } from "./foreign.js";
import { useMoments } from "./moments.js";
import { goLive, jump, openSession } from "./past.js";
import { around, eventTimes, LANES, nextTime, placed, previousTime, saidAt } from "./spans.js";
import { modes, t } from "./texts.js";
import { Component, html, useState } from "./ui.js";
import { lengthWords } from "./when.js";

const LATE_MS = 2000; // the newest span of now ends with the last state, which is up to two seconds old
const NEAR_MS = 30_000;
const MAX_NEAR = 40;
const MAX_SESSIONS = 50;
const WINDOWS = [0, 600_000, 60_000]; // the whole, ten minutes, one

const modeWords = (word) => modes[word]?.[0] ?? word;
const wordsOf = ({ lane, words }) => (lane === "mode" ? modeWords(words) : lane === "driver" ? t.drivenMark(who(words)) : words);

// Drawn again only when its spans, or the window, are others.
class CarLanes extends Component {
  shouldComponentUpdate(next) {
    return next.spans !== this.props.spans || next.from !== this.props.from || next.to !== this.props.to;
  }
  render({ car, spans, from, to }) {
    const shown = placed(spans.filter((each) => each.car === car), from, to);
    return html`<div class="lanes-of" aria-hidden="true">
      ${LANES.map(
        (lane) => html`<div class=${`lane lane-${lane}`} key=${lane}>
          ${shown.filter((each) => each.lane === lane).map((each) => html`<span key=${each.begin} class=${each.bad ? "is-bad" : ""} data-mode=${lane === "mode" ? each.words : undefined}
            title=${wordsOf(each)} style=${{ left: `${100 * each.left}%`, width: `max(2px, ${100 * each.width}%)` }}>${wordsOf(each)}</span>`)}
        </div>`,
      )}
    </div>`;
  }
}

export function TimePage() {
  const { sessions, running, name, shown, at, whole, canScrub, go } = useMoments();
  const { past } = store;
  const [length, setLength] = useState(0);
  const [copied, setCopied] = useState("");
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
  return html`
    <h1>${t.time}</h1>
    <div class="controls">
      <label>${t.timeOf} <select name="session" value=${name} onChange=${choose}>
        <option value="">${t.timeNow}</option>
        ${sessions.slice(0, MAX_SESSIONS).map((each) => html`<option key=${each.name} value=${each.name}>${each.at_ms === null ? seen(each.name) : `${when(each)}, ${lengthWords(each.length_s)}`}${each.name === running ? ` (${t.timeRunning})` : ""}</option>`)}
        ${name && !sessions.slice(0, MAX_SESSIONS).some((each) => each.name === name) && html`<option value=${name}>${seen(name)}</option>`}
      </select></label>
      <label>${t.timeWindow} <select name="window" value=${length} onChange=${(event) => setLength(Number(event.target.value))}>
        ${WINDOWS.map((each) => html`<option key=${each} value=${each}>${t.timeWindows[each]}</option>`)}
      </select></label>
      ${past !== null && html`<button data-link onClick=${copy}>${t.copyLink}</button><span role="status">${copied}</span>`}
    </div>
    ${shown?.loading && shown.begin === undefined && html`<p role="status">${t.timeLoading}</p>`}
    ${shown?.words && html`<p class="bad">⚠ ${shown.words}</p>`}
    ${!canScrub && running !== null && html`<p class="hint">${t.timeUnrecorded}</p>`}
    <div class="controls" role="group" aria-label=${t.timeSteps}>
      ${button("previous", "|◀", t.timePrevious, previousTime(times, at))}
      ${button("back10", "−10 s", t.timeBack(10), at - 10_000)}${button("back1", "−1 s", t.timeBack(1), at - 1000)}
      ${button("on1", "+1 s", t.timeOn(1), at + 1000)}${button("on10", "+10 s", t.timeOn(10), at + 10_000)}
      ${button("next", "▶|", t.timeNext, nextTime(times, at))}
    </div>
    <div class="time">
      <div class="time-scale"><time>${clock(from)}</time><strong data-moment=${at}>${clock(at, 10)}</strong><time>${clock(to)}</time></div>
      <input type="range" name="scrub" aria-label=${t.scrub} aria-valuetext=${clock(at, 10)} min=${from} max=${to} step="100" value=${at}
        disabled=${!canScrub} onInput=${(event) => go(event.target.valueAsNumber)} />
      <div class="time-lanes" onPointerDown=${press}>
        <span class="cursor" style=${{ left: `${(100 * (Math.min(to, Math.max(from, at)) - from)) / (to - from)}%` }}></span>
        ${marks.filter(([when]) => when >= from && when <= to).map(([when, words], index) => html`<span class="mark" key=${index} title=${words} style=${{ left: `${(100 * (when - from)) / (to - from)}%` }}></span>`)}
        ${cars.map(
          (car) => html`<div class="time-car" key=${car} data-lanes=${car}>
            <p><strong>${car}</strong> <span class="dim">${saidAt(spans, car, at, past === null ? LATE_MS : 0).map(wordsOf).join(" · ") || t.timeNothing}</span></p>
            <${CarLanes} car=${car} spans=${spans} from=${from} to=${to} />
          </div>`,
        )}
      </div>
    </div>
    <p class="hint">${t.timeLegend}</p>
    <section><h2>${t.timeAround}</h2>
      ${near.length === 0 && html`<p>${t.timeQuiet}</p>`}
      <ul class="plain">${near.slice(0, MAX_NEAR).map(
        ([when, car, lane, words, bad], index) => html`<li key=${index}><button class="event" disabled=${!canScrub} onClick=${() => go(when)}>
          <time>${clock(when, 10)}</time> <strong>${car}</strong> <span class=${bad ? "bad" : ""}>${bad ? "⚠ " : ""}${lane === "mark" ? `⚑ ${words}` : wordsOf({ lane, words })}</span></button></li>`)}</ul>
    </section>`;
}
