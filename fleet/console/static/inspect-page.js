// The inspect page: raw frames beside what they became, the ledger of commands, and what the gateway knows.

import { motionWords, troublesOf } from "./car-words.js";
import { clock, on, store, unwish, wish } from "./console.js";
import { need } from "./past.js";
import { t } from "./texts.js";
import { html, useEffect, useState } from "./ui.js";

let inspection = null;
on("inspection", (message) => {
  inspection = message;
});

const time = (at_ms) => clock(at_ms, 12);

const Frames = ({ frames }) => html`<section>
  <h2 id="frames">${t.frames}</h2>
  <div class="scroll" tabindex="0" role="region" aria-labelledby="frames">
    <table>
      <thead><tr>${t.frameColumns.map((name) => html`<th key=${name} scope="col">${name}</th>`)}</tr></thead>
      <tbody>
        ${frames.map(
          (frame, index) => html`<tr key=${index}>
            <td>${time(frame.at_ms)}</td><td>${frame.from_car ? t.fromCar : t.toCar}</td>
            <td><code>${frame.text}</code></td><td>${frame.verdict}</td><td>${frame.became}</td>
          </tr>`,
        )}
      </tbody>
    </table>
  </div>
</section>`;

const Ledger = ({ ledger }) => html`<section>
  <h2>${t.ledger}</h2>
  <ul class="plain ledger">
    ${ledger.map(
      (entry, index) => html`<li key=${index}><time>${time(entry.at_ms)}</time> ${entry.level === "info" ? "" : "⚠ "}${entry.words}</li>`,
    )}
  </ul>
</section>`;

const Commands = ({ commands }) => html`<section>
  <h2 id="commands">${t.commands}</h2>
  <div class="scroll" tabindex="0" role="region" aria-labelledby="commands">
    <table>
      <thead><tr>${t.commandColumns.map((name) => html`<th key=${name} scope="col">${name}</th>`)}</tr></thead>
      <tbody>
        ${commands.map(
          (each, index) => html`<tr key=${index} class=${each.bad ? "bad" : ""}>
            <td>${time(each.at_ms)}</td><td>${each.requested}</td><td>${each.bad ? "⚠ " : ""}${each.decided}</td>
            <td><code>${each.wire}</code></td><td>${each.evidence}</td>
          </tr>`,
        )}
      </tbody>
    </table>
  </div>
</section>`;

const Doctor = ({ doctor }) => html`<section data-doctor>
  <h2>${t.doctor}</h2>
  <ul class="plain findings">
    ${doctor.findings.length === 0
      ? html`<li>${doctor.facts.some(([, , isDoubtful]) => isDoubtful) ? `? ${t.onlyDoubts}` : `✓ ${t.nothingOdd}`}</li>`
      : doctor.findings.map((words) => html`<li key=${words}>⚠ ${t.inTerminal(words)}</li>`)}
  </ul>
  <h3>${t.facts}</h3>
  <dl class="wide">${doctor.facts.map(([name, words, isDoubtful]) => html`<div class="row" key=${name}><dt>${name}</dt>
    <dd class=${isDoubtful ? "doubt" : ""}>${isDoubtful ? html`<strong>? ${t.notShown}:</strong> ` : ""}${words}</dd></div>`)}</dl>
</section>`;

// The state of the car in the same words as on all other pages.
const State = ({ car }) => {
  const troubles = troublesOf(car);
  return html`<p data-state class=${troubles.length > 0 ? "bad" : ""}><strong>${car.name}</strong>: ${
    troubles.length > 0 ? `⚠ ${troubles.map((each) => each.words).join(", ")} · ` : ""}${motionWords(car)}</p>`;
};

const Gateway = ({ rows }) => html`<section>
  <h2>${t.gateway}</h2>
  <dl class="wide">${rows.map(([name, words]) => html`<div class="row" key=${name}><dt>${name}</dt><dd>${words}</dd></div>`)}</dl>
</section>`;

export function InspectPage({ cars }) {
  const [car, setCar] = useState([...store.selected][0] ?? cars[0]?.name ?? null);
  const [frozen, setFrozen] = useState(null);
  const isPast = store.past !== null;
  useEffect(() => {
    if (isPast) {
      need({ car: car ?? "" });
      return () => need({ car: "" });
    }
    if (car !== null) wish({ t: "inspect", cars: [car] });
    return () => unwish("inspect", { t: "inspect_end" });
  }, [car, isPast]);
  const newest = isPast ? store.past.detail : inspection;
  const shown = (isPast ? null : frozen) ?? (newest?.car === car ? newest : null);
  return html`
    <h1>${t.inspect}</h1>
    <div class="controls">
      <label>${t.inspectCar} <select value=${car} onChange=${(event) => setCar(event.target.value)}>
        ${cars.map((each) => html`<option key=${each.name} value=${each.name}>${each.name}</option>`)}
      </select></label>
      <button aria-pressed=${frozen !== null} onClick=${() => setFrozen(frozen === null ? shown : null)}>${t.freeze}</button>
    </div>
    ${cars.filter((each) => each.name === car).map((each) => html`<${State} key=${each.name} car=${each} />`)}
    ${shown !== null &&
    html`<${Doctor} doctor=${shown.doctor} />
      <${Frames} frames=${shown.frames} />
      <${Commands} commands=${shown.commands} />
      <div class="columns"><${Ledger} ledger=${shown.ledger} /><${Gateway} rows=${shown.gateway} /></div>`}
  `;
}
