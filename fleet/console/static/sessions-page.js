// The sessions page: the recorder, and the list of recordings with what can be done with each.

import { ask, store, when, who } from "./console.js";
import { seen } from "./foreign.js";
import { linkTo } from "./past.js";
import { t } from "./texts.js";
import { html, Refused, useEffect, useState } from "./ui.js";
import { clockAt, lengthWords } from "./when.js";

const POLL_MS = 2000;

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
      ${status.ok ? `${t.recorderStates[status.state] ?? status.state} ${t.recordingTo(seen(status.session), status.messages, t.size(status.bytes))} ${status.words}` : status.words}
    </p>`}
    <div class="controls">
      ${status?.ok && (on
        ? html`<button data-record="stop" disabled=${refused !== ""} onClick=${() => act("stop")}>${t.recordStop}</button>`
        : html`<button data-record="start" disabled=${refused !== ""} onClick=${() => act("start")}>${t.recordStart}</button>`)}
      ${on && html`<label>${t.markText} <input name="mark" maxlength="1000" value=${text} onInput=${(event) => setText(event.target.value)} /></label>
        <button data-record="mark" disabled=${text.trim() === "" || store.past !== null} onClick=${() => act("mark", text)}>${t.markSet}</button>`}
    </div>
    ${status?.ok && refused && html`<${Refused} words=${[refused]} />`}
    <p role="status">${said}</p>
  </section>`;
}

const MARKS = 5; // the others are one press away

function Marks({ name, marks }) {
  const line = (mark, index) => html`<li key=${index} data-mark=${mark.at_ms}>
    ${mark.at_ms !== null && html`<a href=${linkTo(name, mark.at_ms)}>${clockAt(mark.at_ms, mark.zone_s)}</a>`} ${seen(mark.text)}${mark.by ? html` <span class="dim">${who(mark.by)}</span>` : ""}</li>`;
  if (marks.length === 0) return null;
  const rest = marks.slice(MARKS);
  return html`<ul class="plain marks">${marks.slice(0, MARKS).map(line)}</ul>
    ${rest.length > 0 && html`<details><summary>${t.moreMarks(rest.length)}</summary><ul class="plain marks">${rest.map(line)}</ul></details>`}`;
}

function Session({ session }) {
  const [answer, setAnswer] = useState(null);
  const path = `/sessions/${encodeURIComponent(session.name)}`;
  const title = session.at_ms === null ? seen(session.name) : `${when(session)}, ${lengthWords(session.length_s)}`;
  const act = async (what) => {
    setAnswer({ words: t.working });
    setAnswer(await ask(`${path}/${what}`, ""));
  };
  const button = (what, words) => html`<button key=${what} data-session-do=${what} aria-label=${`${words}: ${title}`} onClick=${() => act(what)}>${words}</button>`;
  const download = html`<a class="button" href=${`${path}/download`} download aria-label=${`${t.download}: ${title}`}>${t.download}</a>`;
  const facts = [t.sessionStates[session.state] ?? session.state, session.cars.join(", "), t.size(session.bytes), session.lost > 0 && t.lostMessages(session.lost), session.kept && t.kept];
  return html`<article class="session" data-session=${session.name}>
    <h3>${title}</h3>
    <p class="facts">${facts.filter(Boolean).join(" · ")}</p>
    ${session.words && html`<p class="bad">⚠ ${session.words}</p>`}
    <${Marks} name=${session.name} marks=${session.marks} />
    <div class="controls">
      <a class="button main" href=${linkTo(session.name)} aria-label=${`${t.lookAt}: ${title}`}>${t.lookAt}</a>
      <details class="others"><summary>${t.otherActions}</summary>
        <div class="controls">
          ${isHere() && button("view", t.rerun)}
          ${download}
          ${button("verify", t.verify)}
          ${Object.entries(t.exportAs).map(([kind, words]) => button(`export/${kind}`, words))}
        </div>
        <p class="hint">${seen(session.name)}${isHere() ? "" : `. ${t.rerunElsewhere}`}</p>
      </details>
    </div>
    <div role="status">
      ${answer !== null && html`<p class="words">${answer.words}</p>`}
      ${answer?.url && (answer.url.startsWith("/")
        ? html`<a class="button" href=${answer.url} download>${t.fetchExport}</a>`
        : html`<a class="button" href=${answer.url} target="_blank" rel="noopener noreferrer">${t.rerunReady}</a>`)}
    </div>
  </article>`;
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
      <h2 id="listed">${t.recordings}</h2>
      <button onClick=${refresh}>${t.refresh}</button>
      ${listed === null && html`<p>${t.working}</p>`}
      ${listed?.words && html`<p>${listed.words}</p>`}
      ${listed?.sessions?.length === 0 && html`<p>${t.noSessions(listed.place)}</p>`}
      ${listed?.sessions?.length > 0 &&
      html`<div class="sessions">${listed.sessions.map((session) => html`<${Session} key=${session.name} session=${session} />`)}</div>`}
    </section>
  `;
}
