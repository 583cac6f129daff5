// The people page: pairs devices on the network, lists them and revokes them.

import { ask } from "./console.js";
import { t } from "./texts.js";
import { html, useEffect, useState } from "./ui.js";

const READ_MS = 2000;
const RANKS = ["person", "lead"];

export const post = (message) => ask("/people", JSON.stringify(message));

// What the console says about the devices on the network, and the function that reads it again. null: nothing is known.
export function useLan() {
  const [found, setFound] = useState(null);
  const read = async () => {
    const answer = await ask("/people");
    setFound("may_pair" in answer ? answer : null);
  };
  useEffect(() => {
    read();
    const timer = setInterval(read, READ_MS);
    return () => clearInterval(timer);
  }, []);
  return [found, read];
}

// The state of a code with a lifetime: the last answer of the console, the seconds left, and functions: `make` asks for a code, `end` hides it,
// `setAnswer` shows another answer.
export function useCode(message) {
  const [answer, setAnswer] = useState(null);
  const [endsAt, setEndsAt] = useState(0);
  const [now, setNow] = useState(performance.now());
  useEffect(() => {
    const timer = setInterval(() => setNow(performance.now()), 1000);
    return () => clearInterval(timer);
  }, []);
  const make = async () => {
    const found = await post(message);
    setAnswer(found);
    setNow(performance.now());
    setEndsAt(performance.now() + 1000 * (found.lifetime_s ?? 0));
  };
  return { answer, left_s: Math.ceil((endsAt - now) / 1000), make, end: () => setEndsAt(0), setAnswer };
}

function NewCode({ address, people }) {
  const [name, setName] = useState("");
  const [rank, setRank] = useState(RANKS[0]);
  const { answer, left_s, make } = useCode({ t: "pair", name, rank });
  const onSubmit = (event) => {
    event.preventDefault();
    make();
  };
  return html`<section>
    <h2>${t.pairTitle}</h2>
    <form class="controls" onSubmit=${onSubmit}>
      <label>${t.pairName} <input name="person" list="people" maxlength="32" required value=${name} onInput=${(event) => setName(event.target.value)} /></label>
      <datalist id="people">${people.map((each) => html`<option key=${each} value=${each} />`)}</datalist>
      <label>${t.pairRank} <select name="rank" value=${rank} onChange=${(event) => setRank(event.target.value)}>
        ${RANKS.map((each) => html`<option key=${each} value=${each}>${each}</option>`)}
      </select></label>
      <button>${t.pairMake}</button>
    </form>
    <div role="status">
      ${answer !== null && !answer.ok && html`<p>${answer.words}</p>`}
      ${answer?.ok && left_s <= 0 && html`<p>${t.pairOver}</p>`}
      ${answer?.ok &&
      left_s > 0 &&
      html`<p>${t.pairHow(address)}</p><p class="code">${answer.code}</p><img class="qr" src=${answer.qr} alt=${t.pairPicture(address)} />`}
    </div>
    ${answer?.ok && left_s > 0 && html`<p>${t.pairLeft(left_s)}</p>`}
  </section>`;
}

function Device({ device, onRevoke }) {
  const [sure, setSure] = useState(false);
  return html`<li class="device" data-device=${device.id}>
    <strong>${device.name}</strong> ${device.rank}, ${t.deviceDays(device.days_left)}<br />
    <span class="hint">${device.device || t.deviceUnknown}. ${t.deviceAt(device.addresses)}</span><br />
    ${sure
      ? html`<button class="danger" onClick=${() => onRevoke(device.id)}>${t.revokeSure}</button>
          <button onClick=${() => setSure(false)}>${t.cancel}</button>`
      : html`<button aria-label=${t.revokeOf(device.name)} onClick=${() => setSure(true)}>${t.revoke}</button>`}
  </li>`;
}

export function PeoplePage() {
  const [found, read] = useLan();
  if (found === null) return html`<h1>${t.people}</h1>`;
  if (!found.may_pair || found.lan === null) {
    return html`<h1>${t.people}</h1><p>${found.may_pair ? t.notOnNetwork : t.mayNotPair}</p>`;
  }
  const { address, people, fingerprint, wrong_codes, devices } = found.lan;
  return html`
    <h1>${t.people}</h1>
    <${NewCode} address=${address} people=${people} />
    <section>
      <h2>${t.devices}</h2>
      ${devices.length === 0 && html`<p>${t.noDevices}</p>`}
      <ul class="plain">
        ${devices.map((device) => html`<${Device} key=${device.id} device=${device} onRevoke=${async (id) => (await post({ t: "revoke", id }), read())} />`)}
      </ul>
    </section>
    <section>
      <h2>${t.security}</h2>
      <p>${t.fingerprint} <code class="fingerprint">${fingerprint}</code></p>
      <p>${t.wrongCodes(wrong_codes)}</p>
    </section>
  `;
}
