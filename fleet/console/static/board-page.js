// The board: what a whole room reads from the wall. A lead lets a class join here, and gives each device a person and a car.

import { directionOf, holderOf, modeWords, motionWords, troublesOf } from "./car-words.js";
import { command, isRefused, store } from "./console.js";
import { post, useCode, useLan } from "./people-page.js";
import { arrows, t } from "./texts.js";
import { html, Results, useState } from "./ui.js";

const LESSON_MINUTES = [10, 45, 90];

function Tile({ car }) {
  const direction = directionOf(car);
  const troubles = troublesOf(car);
  const holder = holderOf(car);
  return html`<li class=${`car board-tile ${direction === "none" ? "" : "moving"} ${troubles.length > 0 ? "bad-tile" : ""}`} style=${{ "--car": car.color }} data-board=${car.name}>
    <h2>${car.name}${direction !== "none" && html` <span aria-hidden="true">${arrows[direction]?.[0] ?? "»"}</span>`}</h2>
    <p><strong>${holder}</strong></p>
    <p class="dim">${[motionWords(car), modeWords(car.mode.asked)].filter((words) => words !== holder).join(" · ")}</p>
    ${troubles.length > 0 && html`<p class="bad">⚠ ${troubles.map((each) => each.words).join(", ")}</p>`}
  </li>`;
}

function ClassCode() {
  const { answer, left_s, make, end, setAnswer } = useCode({ t: "open_class" });
  const close = async () => {
    const found = await post({ t: "close_class" });
    if (found.ok) end();
    else setAnswer(found);
  };
  if (answer === null || !answer.ok || left_s <= 0) {
    return html`<div><button class="main" data-class="open" onClick=${make}>${t.classOpen}</button>
      <p role="status">${answer === null ? "" : answer.ok ? t.classOver : answer.words}</p></div>`;
  }
  return html`<div class="class-code">
    <div class="controls"><h2>${t.classTitle}</h2><span>${t.classLeft(left_s)}</span><button data-class="close" onClick=${close}>${t.classClose}</button></div>
    <img class="qr" src=${answer.qr} alt=${t.pairPicture(answer.address)} />
    <p role="status">${t.classHow(answer.address)}</p>
    <p class="code">${answer.code}</p>
    <p>${t.classThen}</p>
    <p class="hint">${t.classWarning} <code class="fingerprint">${answer.fingerprint}</code></p>
  </div>`;
}

function Guest({ guest, cars, onDone }) {
  const [name, setName] = useState("");
  const [car, setCar] = useState("");
  const [minutes, setMinutes] = useState(LESSON_MINUTES[1]);
  const [words, setWords] = useState("");
  const assign = async (event) => {
    event.preventDefault();
    const found = await post({ t: "assign", id: guest.id, name });
    if (!found.ok) return setWords(found.words);
    if (car !== "") command("lend", [car], { to: name, duration_s: minutes * 60 });
    onDone(t.classAssigned(guest.name, name));
  };
  const lendable = cars.filter((each) => !isRefused("lend", [each.name]));
  return html`<li class="guest-row" data-guest-name=${guest.name}><form class="controls" onSubmit=${assign}>
    <strong>${guest.name}</strong> <span class="hint">${guest.device || t.deviceUnknown}</span>
    <label>${t.className} <input name="person" list="board-people" maxlength="32" required value=${name} onInput=${(event) => setName(event.target.value)} /></label>
    <label>${t.classCar} <select name="car" value=${car} onChange=${(event) => setCar(event.target.value)}>
      <option value="">${t.classNoCar}</option>
      ${lendable.map((each) => html`<option key=${each.name}>${each.name}</option>`)}</select></label>
    ${car !== "" && html`<label>${t.classFor} <select name="minutes" value=${minutes} onChange=${(event) => setMinutes(Number(event.target.value))}>
      ${LESSON_MINUTES.map((count) => html`<option key=${count} value=${count}>${t.minutes(count)}</option>`)}</select></label>`}
    <button aria-label=${t.classAssignOf(guest.name)}>${t.classAssign}</button>
    ${words && html`<p class="bad" role="alert">${words}</p>`}
  </form></li>`;
}

function Guests({ lan, cars, read }) {
  const [done, setDone] = useState("");
  const guests = lan.devices.filter((each) => each.rank === "guest");
  const onDone = (words) => {
    setDone(words);
    read();
  };
  return html`<section class="guests">
    <datalist id="board-people">${lan.people.map((each) => html`<option key=${each} value=${each} />`)}</datalist>
    <h2>${t.classGuests(guests.length)}</h2>
    <p role="status">${done}</p>
    <ul class="plain">${guests.map((guest) => html`<${Guest} key=${guest.id} guest=${guest} cars=${cars} onDone=${onDone} />`)}</ul>
    <${Results} />
  </section>`;
}

const fill = () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());

export function BoardPage({ cars }) {
  const [found, read] = useLan();
  // undefined: a class does not concern this page. In the past nothing is changed.
  const lan = found?.may_pair && store.past === null ? found.lan : undefined;
  return html`<div class="board">
    <div class="controls board-head"><h1>${t.board}</h1>
      ${document.fullscreenEnabled && html`<button data-fill onClick=${fill}>${t.boardFull}</button>`}</div>
    <ul class="plain board-cars">
      ${cars.length === 0 && html`<li>${store.past === null ? t.noCars : t.noCarsThen}</li>`}
      ${cars.map((car) => html`<${Tile} key=${car.name} car=${car} />`)}
    </ul>
    ${lan !== undefined && html`<section class="class" aria-label=${t.classTitle}>${lan === null ? html`<p class="hint">${t.notOnNetwork}</p>` : html`<${ClassCode} />`}</section>`}
    ${lan && html`<${Guests} lan=${lan} cars=${cars} read=${read} />`}
  </div>`;
}
