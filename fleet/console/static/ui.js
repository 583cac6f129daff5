// Preact with htm, and the small parts that all pages use.

import { Component, h, render } from "./vendor/preact.js";
import { useEffect, useRef, useState } from "./vendor/preact-hooks.js";
import htm from "./vendor/htm.js";
import { carSets, store } from "./console.js";
import { t } from "./texts.js";

export const html = htm.bind(h);
export { Component, render, useEffect, useRef, useState };

// Each icon is made once: ten times a second, Preact passes over an element that is the same as before.
const icons = new Map();
export const Icon = ({ path }) => {
  if (!icons.has(path)) icons.set(path, html`<svg class="icon" viewBox="0 0 24 24" aria-hidden="true"><path d=${path} /></svg>`);
  return icons.get(path);
};

// A row that scrolls sideways. Its ends tell when there is more: half a button may look whole.
export function Rail({ name, label, children }) {
  const row = useRef(null);
  const [more, setMore] = useState("");
  useEffect(() => {
    const { current } = row;
    const look = () => {
      const after = current.scrollWidth - current.clientWidth - current.scrollLeft;
      setMore([current.scrollLeft > 1 && "before", after > 1 && "after"].filter(Boolean).join(" "));
    };
    const sizes = new ResizeObserver(look);
    sizes.observe(current);
    const contents = new MutationObserver(look);
    contents.observe(current, { childList: true, characterData: true, subtree: true });
    current.addEventListener("scroll", look, { passive: true });
    return () => {
      sizes.disconnect();
      contents.disconnect();
    };
  }, []);
  return html`<div class=${`rail ${name}-rail`} data-more=${more}><div class=${name} role="group" aria-label=${label} ref=${row}>${children}</div></div>`;
}

// Chips for all cars, the person's own ones, and each group. `isOn` tells which of these sets are chosen.
export const SetChips = ({ cars, label, isOn, onPress }) => {
  const sets = carSets(cars);
  if (sets.length === 1) return null;
  return html`<${Rail} name="sets" label=${label}>
    ${sets.map(
      (set) => html`<button key=${set.key} class="set" data-set=${set.key} aria-pressed=${isOn(set)} onClick=${() => onPress(set)}>
        <bdi>${set.name}</bdi> <small>${set.cars.length}</small></button>`,
    )}
  <//>`;
};

// A symbol for the eye and a word for all: never color alone.
export const Verdict = ({ table, name, detail = "" }) => {
  const [symbol, words] = table[name] ?? ["?", name];
  return html`<span class=${`verdict v-${name.replace(" ", "-")}`}
    ><span class="symbol" aria-hidden="true">${symbol}</span> ${words}${detail && ` ${detail}`}</span
  >`;
};

// A bar for the eye and a number for all.
export function Battery({ battery }) {
  if (!battery) return html`<span class="battery dim">${t.noReading}</span>`;
  const share = battery.charge === null ? null : Math.round(battery.charge * 100);
  return html`<span class=${`battery level-${battery.level}`}>
    ${share !== null && html`<span class="bar" aria-hidden="true"><span style=${{ transform: `scaleX(${share / 100})` }}></span></span>`}
    ${share === null ? `${battery.v.toFixed(1)} V` : `${share} %`}
  </span>`;
}

// Why an action is refused, before it is tried.
export const Refused = ({ words }) => words.map((each) => html`<p class="cannot refused" key=${each}>${each}</p>`);

// A few cards are drawn in each task, so that a press of STOP does not wait for all of them. Layout and paint of twenty
// cards keep a phone busy, so cards out of view are drawn once a second.
const OUT_OF_VIEW_MS = 1000;
const CARDS_IN_A_TASK = 4;
const outdated = new Set();
function drawNext() {
  const some = [...outdated].slice(0, CARDS_IN_A_TASK);
  for (const each of some) outdated.delete(each);
  if (outdated.size > 0) setTimeout(drawNext);
  for (const each of some) each.forceUpdate();
}
function drawSoon(memo) {
  clearTimeout(memo.later);
  memo.later = undefined;
  if (outdated.add(memo).size === 1) setTimeout(drawNext);
}
const view = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    target.memo.inView = isIntersecting;
    if (isIntersecting && target.memo.later !== undefined) drawSoon(target.memo);
  }
});

// Draws again only if its data has changed.
export class Memo extends Component {
  componentDidMount() {
    this.cell.memo = this;
    view.observe(this.cell);
  }
  shouldComponentUpdate(next) {
    if (next.data === this.props.data) return false;
    if (this.inView) drawSoon(this);
    else this.later ??= setTimeout(() => drawSoon(this), OUT_OF_VIEW_MS);
    return false;
  }
  componentWillUnmount() {
    view.unobserve(this.cell);
    clearTimeout(this.later);
    outdated.delete(this);
  }
  render({ draw }) {
    return html`<div class="cell" ref=${(cell) => (this.cell = cell ?? this.cell)}>${draw()}</div>`;
  }
}

export const Results = () => html`<section class="results" aria-live="polite" aria-label=${t.results}>
  <ul class="plain">
    ${store.results.map((result) => html`<li key=${result.key} class=${result.bad ? "bad" : ""}>${result.bad ? "⚠ " : "✓ "}${result.words}</li>`)}
  </ul>
</section>`;
