// The plan page: the plan in force, who has which role and why, and another plan.

import { ask, askBySocket, changed, clock, newestTick, on, store, who } from "./console.js";
import { seen } from "./foreign.js";
import { need } from "./past.js";
import { countsWith, withRoles } from "./plan-text.js";
import { modes, t } from "./texts.js";
import { html, Refused, useEffect, useRef, useState } from "./ui.js";

let inForce = { plan: null, running: false, log: [] };
on("plan", (message) => {
  inForce = message;
});
let answer = null; // to the last request about the plan: {ok, words}
on("plan_done", (message) => {
  answer = message;
});
let tried = null; // the text that the answer is about, if it was checked
// The plan that is being written, as text, and as roles while they are in a form. Somebody who looks at another page finds it
// again. A page that is loaded again (phones do that with a page that slept) has the text.
const DRAFT = "fleet-plan-draft";
let draft = { text: remembered(), form: null };
function remembered() {
  try {
    return sessionStorage.getItem(DRAFT) ?? "";
  } catch {
    return ""; // a browser that keeps nothing
  }
}
function remember(fields) {
  draft = { ...draft, ...fields };
  try {
    sessionStorage.setItem(DRAFT, draft.text);
  } catch {}
  return draft;
}

const request = (verb) => {
  tried = null;
  askBySocket("plan", { verb });
};

// Check the text of a plan, or put it in force.
async function sendPlan(what, text) {
  tried = null;
  answer = { ok: true, words: t.working };
  changed();
  answer = await ask(`/plan/${what}?n=${newestTick()}`, text);
  tried = what === "check" ? text : null;
  changed();
  return answer;
}

const FAULT = /^\u2068?plan:(\d+):\d+: (error|warning): (.*)$/;

// A recording does not say whether the coordinator still ran.
const StatusThen = ({ shown }) =>
  shown.plan === null
    ? html`<p>${t.noPlanThen}</p>`
    : html`<p role="status" data-plan-then><strong>${shown.stopped_by
          ? t.planStopped(seen(shown.plan.name), who(shown.stopped_by))
          : t.planThen(seen(shown.plan.name), shown.plan.set_by && who(shown.plan.set_by))}</strong></p>
        ${shown.phase && html`<p>${t.phase(shown.phase)}</p>`}
        ${shown.rules?.length > 0 && html`<p>${t.rules(shown.rules)}</p>`}`;

function Status({ shown }) {
  if (store.past !== null) return html`<${StatusThen} shown=${shown} />`;
  if (shown.plan === null) return html`<p>${t.noPlan}</p>`;
  const { name, set_by } = shown.plan;
  const refused = store.rights.manage;
  const words = !shown.running
    ? t.planOld(seen(name))
    : shown.stopped_by
      ? t.planStopped(seen(name), who(shown.stopped_by))
      : t.planRuns(seen(name), set_by && who(set_by));
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
  const lines = [...words.split("\n"), ...(answer.warnings ? answer.warnings.split("\n") : [])];
  return html`<div role="status"><ul class="plain">
    ${lines.map((line, index) => {
      const fault = FAULT.exec(line);
      return html`<li key=${index} class=${answer.ok ? "" : "bad"}>
        ${fault
          ? html`<button onClick=${() => onFault(Number(fault[1]))}>${fault[2] === "error" ? "" : "⚠ "}${t.fault(fault[1], seen(fault[3]))}</button>`
          : `${answer.ok ? "✓" : "⚠"} ${line}`}
      </li>`;
    })}
  </ul></div>`;
}

// What another plan would change, and what each car would do first. This is only computed: no car moves.
const modeName = (mode) => (mode in modes ? modes[mode][0] : mode);
function Trial({ found }) {
  const what = (change) => (change.added ? t.planAdded : change.removed ? t.planRemoved : t.planChanged);
  return html`<div class="trial" data-trial>
    ${found.changes &&
    html`<h3>${t.planChanges}</h3>
      ${found.changes.length === 0 && html`<p>${t.planSame}</p>`}
      <ul>
        ${found.changes.map(
          (change) => html`<li key=${change.part} data-change=${change.part}><strong>${seen(change.part)}</strong>: ${what(change)}
            ${!change.removed && html`<ul class="plain">${change.fields.map(([name, before, after]) =>
              html`<li key=${name}>${name}: ${before && !change.added ? html`<del>${before}</del> → ` : ""}<ins>${after || t.planNone}</ins></li>`)}</ul>`}</li>`,
        )}
      </ul>`}
    <h3>${t.planTrial}</h3>
    ${found.cars.length === 0 && html`<p>${t.planNoCars}</p>`}
    <ul class="plain">
      ${found.cars.map(
        (each) => html`<li key=${each.car} data-try=${each.car} data-changed=${each.changed}>
          <details><summary><strong>${each.car}</strong>: ${
            t.planCar(each.role_before, each.role, modeName(each.mode_before), modeName(each.decided), each.changed)}</summary>
            <p>${t.because(each.why)}</p></details></li>`,
      )}
      ${found.lacking.map((each) => html`<li key=${`role ${each.role}`} data-lacking=${each.role}>⚠ ${t.planLacking(each.role, each.decided, each.why)}</li>`)}
    </ul>
  </div>`;
}

// A form for the roles: name, mode, number, and what a car needs. Other fields of a role stay as they are.
function RolesForm({ roles, onChange }) {
  const set = (at, role) => onChange(roles.map((before, index) => (index === at ? role : before)));
  const field = (at, fields) => set(at, [roles[at][0], { ...roles[at][1], ...fields }]);
  return html`<fieldset class="bare role-form" data-form="roles"><legend class="unseen">${t.planForm}</legend>
    ${roles.map(
      ([name, fields], at) => html`<div class="role-row" key=${at} data-form-role=${at}>
        <label>${t.roleName} <input name="role" maxlength="32" value=${name} onInput=${(event) => set(at, [event.target.value, fields])} /></label>
        <label>${t.mode} <select name="mode" value=${fields.mode} onChange=${(event) => field(at, { mode: event.target.value })}>
          ${Object.entries(modes).filter(([mode]) => mode !== "unknown").map(([mode, [words]]) => html`<option key=${mode} value=${mode}>${words}</option>`)}
        </select></label>
        <label>${t.roleCount} <select name="count" value=${String(fields.count ?? 1)} onChange=${(event) =>
          field(at, { count: event.target.value === "all" ? "all" : Number(event.target.value) })}>
          ${countsWith(fields.count ?? 1).map((count) => html`<option key=${count} value=${count}>${count === "all" ? t.roleAll : count}</option>`)}
        </select></label>
        <label>${t.roleNeeds} <input name="needs" value=${fields.needs ?? ""} placeholder="battery_v > 7" onInput=${(event) => field(at, { needs: event.target.value })} /></label>
        <button aria-label=${`${t.roleRemove} ${name}`} onClick=${() => onChange(roles.filter((_, index) => index !== at))}>✕</button>
      </div>`,
    )}
    <div class="controls"><button data-form="add" onClick=${() => onChange([...roles, ["", { mode: "manual" }]])}>${t.roleAdd}</button></div>
    <p class="hint">${t.planFormHint}</p>
  </fieldset>`;
}

function Editor({ current }) {
  const [{ text, form }, setDraft] = useState(draft);
  const [examples, setExamples] = useState([]);
  const area = useRef(null);
  useEffect(() => {
    ask("/plan/examples").then((found) => setExamples(found.examples ?? []));
  }, []);
  const change = (fields) => setDraft(remember(fields));
  const setForm = (roles) => change({ form: roles });
  const take = (words) => change({ text: words, form: null });
  // Select the line of a fault in the text.
  const show = (line) => {
    const lines = text.split("\n");
    const begin = lines.slice(0, line - 1).reduce((sum, each) => sum + each.length + 1, 0);
    area.current.focus();
    area.current.setSelectionRange(begin, begin + (lines[line - 1] ?? "").length);
  };
  const load = async (event) => {
    const [file] = event.target.files;
    if (file !== undefined) take(await file.text());
  };
  const example = (event) => {
    const found = examples[Number(event.target.value)];
    if (event.target.value !== "" && found !== undefined) take(found.text);
  };
  const openForm = async () => {
    if (form !== null) return setForm(null);
    if (text.trim() === "") return setForm([["", { mode: "manual" }]]);
    const found = await sendPlan("check", text);
    if (found.roles) setForm(found.roles);
  };
  const write = (roles) => change({ text: withRoles(text, roles), form: roles });
  const refused = store.rights.manage;
  const isTried = tried !== null && tried === text && answer.ok;
  return html`<section>
    <h2>${t.otherPlan}</h2>
    <div class="controls">
      ${examples.length > 0 && html`<label>${t.planExample} <select name="example" onChange=${example}>
        <option value="">${t.planChoose}</option>
        ${examples.map((each, index) => html`<option key=${index} value=${index}>${each.name}</option>`)}
      </select></label>`}
      <label>${t.planFile} <input type="file" accept=".yaml,.yml" onChange=${load} /></label>
      ${current && html`<button onClick=${() => take(current)}>${t.planCurrent}</button>`}
      <button data-plan="form" aria-expanded=${form !== null} onClick=${openForm}>${t.planForm}</button>
    </div>
    ${form !== null && html`<${RolesForm} roles=${form} onChange=${write} />`}
    <textarea ref=${area} aria-label=${t.planText} rows="14" spellcheck="false" value=${text}
      onInput=${(event) => take(event.target.value)}></textarea>
    <div class="controls">
      <button data-plan="check" disabled=${text.trim() === ""} onClick=${() => sendPlan("check", text)}>${t.planCheck}</button>
      <button data-plan="set" class=${isTried ? "main" : ""} disabled=${refused !== "" || !isTried} onClick=${() => sendPlan("set", text)}>${t.planSet}</button>
    </div>
    ${!isTried && !refused && html`<p class="hint">${t.planTryFirst}</p>`}
    ${refused && html`<${Refused} words=${[refused]} />`}
    <${Answer} onFault=${show} />
    ${tried === text && answer.cars && html`<${Trial} found=${answer} />`}
  </section>`;
}

const NO_PLAN = { plan: null, log: [] };

export function PlanPage() {
  const isPast = store.past !== null;
  const shown = isPast ? (store.past.plan ?? NO_PLAN) : inForce;
  useEffect(() => {
    need({ plan: true });
    return () => need({ plan: false });
  }, []);
  return html`
    <h1>${t.plan}</h1>
    <div class="columns">
      <div>
        <${Status} shown=${shown} />
        ${shown.roles && html`<${Roles} roles=${shown.roles} />`}
        ${shown.decisions && html`<${Decisions} decisions=${shown.decisions} />`}
        ${isPast && shown.decisions && html`<p class="hint">${t.planThenWhy}</p>`}
        ${shown.log.length > 0 &&
        html`<section>
          <h2>${t.coordinator}</h2>
          <ul class="plain">
            ${shown.log.map((each, index) => html`<li key=${index}><time>${clock(each.at_ms)}</time> ${each.bad ? "⚠ " : ""}${each.words}</li>`)}
          </ul>
        </section>`}
      </div>
      ${isPast ? shown.plan && html`<section><h2>${t.planText}</h2><pre class="scroll" tabindex="0">${seen(shown.plan.text)}</pre></section>` : html`<${Editor} current=${shown.plan?.text} />`}
    </div>
  `;
}
