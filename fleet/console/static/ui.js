// Preact with htm, and the small parts that all pages use.

import { Component, h, render } from "./vendor/preact.js";
import { useEffect, useRef, useState } from "./vendor/preact-hooks.js";
import htm from "./vendor/htm.js";
import { store } from "./console.js";
import { t } from "./texts.js";

export const html = htm.bind(h);
export { Component, render, useEffect, useRef, useState };

// A symbol for the eye and a word for all: never color alone.
export const Verdict = ({ table, name, detail = "" }) => {
  const [symbol, words] = table[name] ?? ["?", name];
  return html`<span class=${`verdict v-${name.replace(" ", "-")}`}
    ><span class="symbol" aria-hidden="true">${symbol}</span> ${words}${detail && ` ${detail}`}</span
  >`;
};

// Why an action is refused, before it is tried.
export const Refused = ({ words }) => words.map((each) => html`<p class="cannot refused" key=${each}>${each}</p>`);

// Draws again only if its data has changed, one in each task: a press of STOP waits for one card, not for all.
const outdated = new Set();
function drawNext() {
  const [next] = outdated;
  outdated.delete(next);
  if (outdated.size > 0) setTimeout(drawNext);
  next?.forceUpdate();
}

export class Memo extends Component {
  shouldComponentUpdate(next) {
    if (next.data !== this.props.data && outdated.add(this).size === 1) setTimeout(drawNext);
    return false;
  }
  componentWillUnmount() {
    outdated.delete(this);
  }
  render({ draw }) {
    return draw();
  }
}

export const Results = () => html`<section class="results" aria-live="polite" aria-label=${t.results}>
  <ul class="plain">
    ${store.results.map((result) => html`<li key=${result.key} class=${result.bad ? "bad" : ""}>${result.bad ? "⚠ " : "✓ "}${result.words}</li>`)}
  </ul>
</section>`;
