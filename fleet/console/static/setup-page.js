// The set-up page: find the cars, let each blink, give it a name, write the fleet file.

import { ask } from "./console.js";
import { seen } from "./foreign.js";
import { t } from "./texts.js";
import { html, useEffect, useState } from "./ui.js";

function Found({ found, name, onName, busy, onBusy }) {
  const [said, setSaid] = useState("");
  const blink = async () => {
    onBusy(true);
    setSaid(t.working);
    const answer = await ask("/setup/blink", JSON.stringify({ url: found.url }));
    onBusy(false);
    setSaid(answer.ok ? t.setupBlinked : answer.words);
  };
  return html`<li class="card" data-link=${found.url}>
    <p><strong>${seen(found.url)}</strong><br /><span class="hint">${found.words}</span> ${found.car && t.setupKnown(found.car)}</p>
    <div class="controls">
      <button disabled=${busy} data-setup="blink" aria-label=${`${t.setupBlink}: ${found.url}`} onClick=${blink}>${t.setupBlink}</button>
      <label>${t.setupName} <input name="car" maxlength="32" autocapitalize="none" aria-label=${t.setupNameOf(found.url)} value=${name} onInput=${(event) => onName(event.target.value)} /></label>
    </div>
    <p role="status">${said}</p>
  </li>`;
}

export function SetupPage() {
  const [file, setFile] = useState(null);
  const [links, setLinks] = useState("");
  const [found, setFound] = useState(null);
  const [names, setNames] = useState({});
  const [busy, setBusy] = useState(false);
  const [answer, setAnswer] = useState(null);
  const look = async () => setFile(await ask("/setup/file", ""));
  useEffect(() => {
    look();
  }, []);
  const scan = async () => {
    setBusy(true);
    setAnswer({ words: t.working });
    const said = await ask("/setup/scan", JSON.stringify({ links: links.split(/\s+/).filter(Boolean) }));
    setBusy(false);
    setAnswer(said);
    setFound(said.found ?? []);
    setNames(Object.fromEntries((said.found ?? []).map((each) => [each.url, each.car])));
  };
  const named = (found ?? []).filter((each) => names[each.url]);
  const write = async (replace) => {
    const cars = named.map((each) => ({ name: names[each.url].trim(), url: each.url, platform: each.platform }));
    setAnswer(await ask("/setup/write", JSON.stringify({ cars, replace })));
    look();
  };
  return html`
    <h1>${t.setup}</h1>
    ${file !== null && html`<section aria-labelledby="file">
      <h2 id="file">${t.setupCars}</h2>
      <p>${file.ok ? t.setupFile(file.file, file.exists) : html`<span class="words">${file.words}</span>`}</p>
      <dl class="wide">${(file.cars ?? []).map(([car, link]) => html`<div class="row" key=${car}><dt>${car}</dt><dd>${link || t.noLink}</dd></div>`)}</dl>
    </section>`}
    <div class="controls">
      <label>${t.setupLinks} <input name="links" value=${links} onInput=${(event) => setLinks(event.target.value)} /></label>
      <button disabled=${busy} data-setup="scan" onClick=${scan}>${t.setupScan}</button>
    </div>
    ${found !== null && found.length > 0 && html`<section aria-labelledby="found">
      <h2 id="found">${t.setupFound}</h2>
      <ul class="plain cards">
        ${found.map((each) => html`<${Found} key=${each.url} found=${each} busy=${busy} onBusy=${setBusy} name=${names[each.url] ?? ""}
          onName=${(name) => setNames((before) => ({ ...before, [each.url]: name }))} />`)}
      </ul>
      <p><button disabled=${busy || named.length === 0} data-setup="write" onClick=${() => write(false)}>${t.setupWrite}</button></p>
    </section>`}
    <div role="status"><p class="words">${answer?.words ?? ""}</p></div>
    ${answer?.confirm && html`<button class="danger" data-setup="replace" onClick=${() => write(true)}>${t.setupReplace}</button>`}
  `;
}
