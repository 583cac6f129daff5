// The sessions page: the recorder, and the list of recordings with what can be done with each.

import { ask, store } from "./console.js";
import { seen } from "./foreign.js";
import { t } from "./texts.js";
import { html, Refused, useEffect, useState } from "./ui.js";

const POLL_MS = 2000;

const length = (s) => `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, "0")}`;

const isHere = () => ["127.0.0.1", "localhost"].includes(location.hostname);

function Recorder({ onChange }) {
  const [status, setStatus] = useState(null);
  const [text, setText] = useState("");
  const [said, setSaid] = useState("");
  useEffect(() => {
    let over = false;
    const look = async () => {
      const answer = await ask("/recording/status", "");
      if (!over) setStatus(answer);
    };
    look();
    const timer = setInterval(look, POLL_MS);
    return () => {
      over = true;
      clearInterval(timer);
    };
  }, []);
  const act = async (verb, body = "") => {
    const answer = await ask(`/recording/${verb}`, body);
    setSaid(answer.ok ? (verb === "mark" ? t.marked : "") : answer.words);
    if (!answer.ok) return;
    setStatus(answer);
    if (verb === "mark") setText("");
    onChange();
  };
  const on = status?.state === "recording";
  const refused = store.rights.manage;
  return html`<section aria-labelledby="recording">
    <h2 id="recording">${t.recording}</h2>
    ${status !== null && html`<p data-recorder=${status.state ?? "none"}>
      ${status.ok ? `${t.recorderStates[status.state] ?? status.state} ${t.recordingTo(status.session, status.messages, t.size(status.bytes))} ${status.words}` : status.words}
    </p>`}
    <div class="controls">
      ${status?.ok && (on
        ? html`<button data-record="stop" disabled=${refused !== ""} onClick=${() => act("stop")}>${t.recordStop}</button>`
        : html`<button data-record="start" disabled=${refused !== ""} onClick=${() => act("start")}>${t.recordStart}</button>`)}
      ${on && html`<label>${t.markText} <input name="mark" maxlength="1000" value=${text} onInput=${(event) => setText(event.target.value)} /></label>
        <button data-record="mark" disabled=${text.trim() === ""} onClick=${() => act("mark", text)}>${t.markSet}</button>`}
    </div>
    ${status?.ok && refused && html`<${Refused} words=${[refused]} />`}
    <p role="status">${said}</p>
  </section>`;
}

function Row({ session }) {
  const [answer, setAnswer] = useState(null);
  const path = `/sessions/${encodeURIComponent(session.name)}`;
  const act = async (what) => {
    setAnswer({ words: t.working });
    setAnswer(await ask(`${path}/${what}`, ""));
  };
  const button = (what, words) => html`<button key=${what} data-session-do=${what} aria-label=${`${words}: ${seen(session.name)}`} onClick=${() => act(what)}>${words}</button>`;
  const cells = [length(session.length_s), t.size(session.bytes), session.lost, session.marks.length || "", session.cars.join(", ")];
  return html`<tr data-session=${session.name}>
    <th scope="row">${seen(session.name)}</th>
    <td>${t.sessionStates[session.state] ?? session.state}${session.words && html`<br /><small>${session.words}</small>`}</td>
    ${cells.map((cell, index) => html`<td key=${index}>${cell}</td>`)}
    <td>
      <div class="controls">
        ${button("verify", t.verify)}
        <a class="button" href=${`${path}/download`} download aria-label=${`${t.download}: ${seen(session.name)}`}>${t.download}</a>
        ${Object.entries(t.exportAs).map(([kind, words]) => button(`export/${kind}`, words))}
        ${isHere() ? button("view", t.rerun) : html`<small>${t.rerunElsewhere}</small>`}
      </div>
      <div role="status">
        ${answer !== null && html`<p class="words">${answer.words}</p>`}
        ${answer?.url && (answer.url.startsWith("/")
          ? html`<a class="button" href=${answer.url} download>${t.fetchExport}</a>`
          : html`<a class="button" href=${answer.url} target="_blank" rel="noopener noreferrer">${t.rerunReady}</a>`)}
      </div>
    </td>
  </tr>`;
}

export function SessionsPage() {
  const [listed, setListed] = useState(null);
  const refresh = async () => setListed(await ask("/sessions"));
  useEffect(() => {
    refresh();
  }, []);
  return html`
    <h1>${t.sessions}</h1>
    <${Recorder} onChange=${refresh} />
    <section aria-labelledby="listed">
      <h2 id="listed">${t.sessions}</h2>
      <button onClick=${refresh}>${t.refresh}</button>
      ${listed === null && html`<p>${t.working}</p>`}
      ${listed?.words && html`<p>${listed.words}</p>`}
      ${listed?.sessions?.length === 0 && html`<p>${t.noSessions(listed.place)}</p>`}
      ${listed?.sessions?.length > 0 &&
      html`<div class="sessions" tabindex="0" role="region" aria-labelledby="listed">
        <table>
          <thead><tr>${t.sessionColumns.map((name) => html`<th key=${name} scope="col">${name}</th>`)}</tr></thead>
          <tbody>${listed.sessions.map((session) => html`<${Row} key=${session.name} session=${session} />`)}</tbody>
        </table>
      </div>`}
    </section>
  `;
}
