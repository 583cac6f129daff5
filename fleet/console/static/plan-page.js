// The plan page: the plan in force, who has which role and why, and another plan.

import { ask, askBySocket, changed, clock, on, store, who } from "./console.js";
import { seen } from "./foreign.js";
import { t } from "./texts.js";
import { html, Refused, useRef, useState } from "./ui.js";

let inForce = { plan: null, running: false, log: [] };
on("plan", (message) => {
  inForce = message;
});
let answer = null; // of the last request about the plan: {ok, words}
on("plan_done", (message) => {
  answer = message;
});

const request = (verb) => askBySocket("plan", { verb });

// Check the text of a plan, or put it in force.
async function sendPlan(what, text) {
  answer = await ask(`/plan/${what}`, text);
  changed();
}

const FAULT = /^\u2068?plan:(\d+):(\d+): error: (.*)$/;

function Status({ shown }) {
  if (shown.plan === null) return html`<p>${t.noPlan}</p>`;
  const { version, set_by } = shown.plan;
  const refused = store.rights.manage;
  const words = !shown.running
    ? t.planOld(version)
    : shown.stopped_by
      ? t.planStopped(version, who(shown.stopped_by))
      : t.planRuns(version, set_by && who(set_by));
  return html`<p role="status"><strong>${words}</strong></p>
    ${shown.phase && html`<p>${t.phase(shown.phase)}</p>`}
    ${shown.rules?.length > 0 && html`<p>${t.rules(shown.rules)}</p>`}
    <div class="controls">
      <button data-plan="restart" disabled=${refused !== ""} onClick=${() => request("restart")}>${t.planRestart}</button>
      ${shown.phase && html`<button data-plan="next" disabled=${refused !== ""} onClick=${() => request("next")}>${t.planNext}</button>`}
      <button data-plan="stop" disabled=${refused !== ""} onClick=${() => request("stop")}>${t.planStop}</button>
    </div>
    ${refused && html`<${Refused} words=${[refused]} />`}`;
}

const Roles = ({ roles }) => html`<section>
  <h2>${t.roles}</h2>
  <dl>
    ${roles.map(
      (role) => html`<div class="row" key=${role.name} data-role=${role.name}><dt>${seen(role.name)}</dt><dd>${role.cars.join(", ") || t.noCar}</dd></div>`,
    )}
  </dl>
</section>`;

const Decisions = ({ decisions }) => html`<section>
  <h2>${t.why}</h2>
  ${decisions.map(
    (each) => html`<details key=${each.subject} data-why=${each.subject}>
      <summary><strong>${each.subject}</strong>: ${each.decided} <time>${clock(each.since * 1000)}</time></summary>
      <p>${t.because(each.why)}</p>
      <ul>
        ${each.readings.map((words) => html`<li key=${words}>${t.reading(words)}</li>`)}
        ${each.would_change.map((words) => html`<li key=${words}>${t.wouldChange(words)}</li>`)}
      </ul>
    </details>`,
  )}
</section>`;

function Answer({ onFault }) {
  if (answer === null) return null;
  const words = answer.words || (answer.ok ? t.planGood : "");
  return html`<div role="status"><ul class="plain">
    ${words.split("\n").map((line, index) => {
      const fault = FAULT.exec(line);
      return html`<li key=${index} class=${answer.ok ? "" : "bad"}>
        ${fault
          ? html`<button onClick=${() => onFault(Number(fault[1]))}>${t.fault(fault[1], seen(fault[3]))}</button>`
          : `${answer.ok ? "✓" : "⚠"} ${line}`}
      </li>`;
    })}
  </ul></div>`;
}

function Editor({ current }) {
  const [text, setText] = useState("");
  const area = useRef(null);
  // Select the line of a fault in the text.
  const show = (line) => {
    const lines = text.split("\n");
    const begin = lines.slice(0, line - 1).reduce((sum, each) => sum + each.length + 1, 0);
    area.current.focus();
    area.current.setSelectionRange(begin, begin + (lines[line - 1] ?? "").length);
  };
  const load = async (event) => {
    const [file] = event.target.files;
    if (file !== undefined) setText(await file.text());
  };
  return html`<section>
    <h2>${t.otherPlan}</h2>
    <div class="controls">
      <label>${t.planFile} <input type="file" accept=".yaml,.yml" onChange=${load} /></label>
      ${current && html`<button onClick=${() => setText(current)}>${t.planCurrent}</button>`}
    </div>
    <textarea ref=${area} aria-label=${t.planText} rows="14" spellcheck="false" value=${text}
      onInput=${(event) => setText(event.target.value)}></textarea>
    <div class="controls">
      <button data-plan="check" onClick=${() => sendPlan("check", text)}>${t.planCheck}</button>
      <button data-plan="set" disabled=${store.rights.manage !== ""} onClick=${() => sendPlan("set", text)}>${t.planSet}</button>
    </div>
    ${store.rights.manage && html`<${Refused} words=${[store.rights.manage]} />`}
    <${Answer} onFault=${show} />
  </section>`;
}

export function PlanPage() {
  const shown = inForce;
  return html`
    <h1>${t.plan}</h1>
    <div class="columns">
      <div>
        <${Status} shown=${shown} />
        ${shown.roles && html`<${Roles} roles=${shown.roles} />`}
        ${shown.decisions && html`<${Decisions} decisions=${shown.decisions} />`}
        ${shown.log.length > 0 &&
        html`<section>
          <h2>${t.coordinator}</h2>
          <ul class="plain">
            ${shown.log.map((each, index) => html`<li key=${index}><time>${clock(each.at_ms)}</time> ${each.bad ? "⚠ " : ""}${each.words}</li>`)}
          </ul>
        </section>`}
      </div>
      <${Editor} current=${shown.plan?.text} />
    </div>
  `;
}
