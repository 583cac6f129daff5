// The fleet page: a tile for each car, to be read at a glance, and all about the chosen one.
//
// No tile ever moves: a press must not meet another car than the one that the eye has chosen. So each tile has one
// size whatever is in it, and what comes and goes (trouble, all about a car) has a place of its own.

import { directionOf, driverOf, isLost, isMoving, isUnconfirmed, isUnheard, modeWords, motorName, silence, troublesOf } from "./car-words.js";
import { carSets, changed, clock, command, isRefused, refusals, select, store, unheard_s, who } from "./console.js";
import { arrows, links, motions, motors, t, tileMotors, trends, verdicts } from "./texts.js";
import { Battery, html, Memo, Rail, Refused, Results, SetChips, useState, Verdict } from "./ui.js";

const Lamps = ({ values, words }) => html`<span class="lamps">
  <span aria-hidden="true">${values.map((on) => html`<span class=${on ? "lamp on" : "lamp"}>${on ? "◉" : "○"}</span>`)}</span>
  <span class="lamp-words">${words}</span>
</span>`;

const seen = (values, names) => names.filter((_, index) => values[index]);

const Row = ({ name, children }) => html`<div class="row"><dt>${name}</dt><dd>${children}</dd></div>`;

const Alarm = ({ words, todo }) => html`<div class="alarm"><p><strong>${words}</strong></p><p>${todo}</p></div>`;

function Trouble({ car }) {
  if (!car.gateway) return html`<${Alarm} words=${t.gone(car.name, t.ago(car.gone_s ?? 0))} todo=${t.goneDo} />`;
  const ago = t.ago(car.link.since_s);
  if (car.link.state === "lost") {
    const words = (motors[motorName(car)] ?? motors.unknown)[1];
    return html`<${Alarm} words=${t.lost(car.name, ago, words)} todo=${`${car.link.reason} ${t.lostDo}`} />`;
  }
  return html`${isUnconfirmed(car) && html`<${Alarm} words=${t.unconfirmed(car.name)} todo=${t.unconfirmedDo} />`}
    ${isUnheard(car) && html`<${Alarm} words=${t[car.link.state](car.name, ago)} todo=${t[`${car.link.state}Do`]} />`}`;
}

function Estops({ car }) {
  const [sure, setSure] = useState(false);
  if (car.estops.length === 0) return null;
  const end = () => {
    setSure(false);
    command("resume", [car.name], { ids: car.estops.map((estop) => estop.id) });
  };
  return html`<div class="alarm">
    <p class="latched"><span aria-hidden="true">⛔</span> ${t.estopped}</p>
    ${car.estops.map((estop) => html`<p key=${estop.id}>${t.estopLine(who(estop.by), estop.why, estop.scope)}</p>`)}
    ${sure
      ? html`<button class="danger" onClick=${end}>${t.endEstopSure}</button>
          <button onClick=${() => setSure(false)}>${t.cancel}</button>`
      : html`<button disabled=${isRefused("end_estops", [car.name])} onClick=${() => setSure(true)}>${t.endEstop}</button>`}
    <${Refused} words=${refusals("end_estops", [car.name])} />
  </div>`;
}

const Hold = ({ car }) =>
  car.hold === null || car.estops.length > 0
    ? null
    : html`<div class="note">
        <p>${t.held(who(car.hold))}</p>
        <button disabled=${isRefused("resume", [car.name])} onClick=${() => command("resume", [car.name])}
          aria-label=${`${t.resume} ${car.name}`}>${t.resume}</button>
        <${Refused} words=${refusals("resume", [car.name])} />
      </div>`;

const Loan = ({ car }) =>
  car.loan === undefined
    ? null
    : html`<div class="note">
        <p>${t.lentTo(car.loan.to, who(car.loan.by), clock(car.loan.until_s * 1000, 5))}</p>
        <button disabled=${isRefused("end_loan", [car.name])} onClick=${() => command("end_loan", [car.name])}
          aria-label=${`${t.endLoan} ${car.name}`}>${t.endLoan}</button>
      </div>`;

const Motion = ({ car }) =>
  isMoving(car)
    ? html`<strong>${car.motion.motion in arrows ? arrows[car.motion.motion][1] : t.isMoving}</strong>`
    : html`<${Verdict} table=${tileMotors} name=${motorName(car)} />`;

// Who drives a car or has borrowed it, and whether it is on hold.
function markOf(car) {
  const driver = driverOf(car);
  const kept = car.hold !== null ? t.holdMark : car.loan !== undefined ? t.lentMark(car.loan.to) : "";
  return [driver ? t.drivenMark(who(driver)) : "", kept].filter(Boolean).join(", ");
}

let chosen = null; // the car that the page shows all about
function choose(name) {
  chosen = name;
  changed();
}

// A few cars have large tiles on a large screen. Once drawn, tiles keep their size: no tile moves when cars come.
const FEW = 8;
let isFew = null;

let filter = "all"; // the key of the set of cars that the page shows
function filterBy(key) {
  filter = key;
  changed();
}

function Tile({ car }) {
  const troubles = troublesOf(car);
  const direction = directionOf(car);
  return html`<button class=${`tile car ${direction === "none" ? "" : "moving"} ${troubles[0]?.level ?? ""}`} style=${{ "--car": car.color }}
    data-car=${car.name} data-direction=${direction} aria-pressed=${chosen === car.name} onClick=${() => choose(car.name)}>
    <span class="tile-name">${car.name}</span>
    <span class="tile-arrow" aria-hidden="true">${direction === "none" ? "" : (arrows[direction]?.[0] ?? "»")}</span>
    <span class="tile-motion"><${Motion} car=${car} /></span>
    <span class="tile-mode">${modeWords(car.mode.asked)}</span><${Battery} battery=${car.battery} />
    <span class="tile-trouble">
      ${troubles.length > 0
        ? html`<span class="bad" data-old=${silence(car) > 0 ? "" : undefined}>⚠ ${troubles.map((each) => each.words).join(", ")}</span>${" "}`
        : ""}${markOf(car)}
    </span>
  </button>`;
}

const TroubleStrip = ({ cars }) => {
  const troubled = cars.filter((car) => troublesOf(car).length > 0);
  const show = (name) => {
    filter = "all"; // so that the tile is there, too
    choose(name);
    document.querySelector(`[data-car="${CSS.escape(name)}"]`)?.scrollIntoView({ block: "nearest" });
  };
  return html`<${Rail} name="strip" label=${t.trouble}>
    ${troubled.length === 0
      ? html`<p class="hint">${t.noTrouble}</p>`
      : troubled.map(
          (car) => html`<button key=${car.name} data-trouble=${car.name} onClick=${() => show(car.name)}>
            ⚠ <strong>${car.name}</strong> ${troublesOf(car)[0].short}</button>`,
        )}
  <//>`;
};

function Details({ car }) {
  const { battery, mode, event } = car;
  const silent_s = silence(car);
  const reports = car.gateway && silent_s === 0 && (car.link.state === "online" || car.link.state === "quiet");
  const missing = reports ? t.notMeasured : t.notKnown;
  return html`<article class="card car" style=${{ "--car": car.color }} aria-label=${t.details(car.name)} data-details=${car.name}>
    <header>
      <h2>${car.name}</h2>
      <span class="platform">${car.platform}</span>
      <button class="close" aria-label=${`${t.close} ${car.name}`} onClick=${() => choose(null)}>✕</button>
    </header>
    <footer>
      <a class="button" href="#/drive" onClick=${() => select([car.name])} aria-label=${`${t.drive} ${car.name}`}>${t.drive}</a>
      <button class="stop-one" onClick=${() => command("stop", [car.name])} aria-label=${`${t.stopCar} ${car.name}`}>
        ${t.stopCar}
      </button>
    </footer>
    <${Results} />
    <${Trouble} car=${car} />
    ${silent_s > 0 && html`<p class="note">${t.old(t.ago(silent_s))}</p>`}
    <${Estops} car=${car} />
    <${Hold} car=${car} />
    <${Loan} car=${car} />
    <dl>
      <${Row} name=${t.link}><${Verdict} table=${links} name=${car.gateway ? car.link.state : "lost"} /><//>
      <${Row} name=${t.mode}>
        ${modeWords(mode.asked)}${" "}
        <${Verdict} table=${verdicts} name=${mode.verdict}
          detail=${mode.verdict === "contradicted" ? modeWords(mode.inferred) : ""} />
      <//>
      <${Row} name=${t.motors}><${Verdict} table=${motors} name=${motorName(car)} />${car.motors.past ? ` ${t.wasThen(car.motors.past, t.ago(car.motors.past_s + unheard_s()))}` : ""}<//>
      ${car.shows && car.shows !== "yes" && html`<${Row} name=${t.showsStops}>${t.shows[car.shows] ?? ""} ${car.shows_words}<//>`}
      <${Row} name=${t.motion}>${motions[car.motion.motion]}${car.motion.owner ? ` (${who(car.motion.owner)})` : ""}<//>
      <${Row} name=${t.battery}>
        ${battery
          ? html`<span class=${`level-${battery.level}`}>
              ${battery.v.toFixed(1)} V${battery.charge === null ? "" : ` · ${Math.round(battery.charge * 100)} %`}
              ${battery.level === "ok" ? "" : ` · ⚠ ${battery.level}`} ${trends[battery.trend] ?? ""}</span
            >`
          : missing}
      <//>
      <${Row} name=${t.distance}>
        ${car.range_m === undefined ? missing : car.range_m === null ? t.noEcho : `${car.range_m.toFixed(2)} m`}
      <//>
      <${Row} name=${t.line}>
        ${car.line ? html`<${Lamps} values=${car.line} words=${t.seesLine(seen(car.line, t.lineNames))} />` : missing}
      <//>
      <${Row} name=${t.obstacle}>
        ${car.obstacle
          ? html`<${Lamps} values=${car.obstacle} words=${t.seesObstacle(seen(car.obstacle, t.sideNames))} />`
          : missing}
      <//>
      <${Row} name=${t.control}>${car.lease ? t.leaseOf(who(car.lease.holder), car.lease.kind) : t.nobody}<//>
      <${Row} name=${t.event}>
        ${event
          ? html`<time>${clock(event.at_ms)}</time>${" "}
              ${event.level === "info" ? "" : "⚠ "}${event.words}`
          : "–"}
      <//>
    </dl>
  </article>`;
}

// A tile is drawn again if anything that it shows has changed, or if it is chosen.
const drawn = (car, ...more) => JSON.stringify([car, store.rights.cars[car.name], unheard_s(), store.past === null, ...more]);

export function FleetPage({ cars }) {
  if (cars.length > 0) isFew ??= cars.length <= FEW;
  const shown = cars.find((car) => car.name === chosen);
  const count = (is) => cars.filter(is).length;
  const troubled = count((car) => troublesOf(car).length > 0);
  const set = carSets(cars).find((each) => each.key === filter && filter !== "all");
  // A car that has gone leaves its place empty.
  const places = set === undefined ? store.places : store.places.filter((name) => set.members.includes(name));
  const byName = new Map(cars.map((car) => [car.name, car]));
  return html`<div class="fleet">
    <div class="summary">
      <h1>${t.fleet}</h1>
      <p data-summary>${t.summary(cars.length, count(isMoving), count((car) => car.hold !== null), troubled)}</p>
      <${SetChips} cars=${cars} label=${t.filter} isOn=${(each) => each.key === (set?.key ?? "all")} onPress=${(each) => filterBy(each.key)} />
    </div>
    <${TroubleStrip} cars=${cars} />
    <div class=${isFew ? "tiles few" : "tiles"}>
      ${cars.length === 0 && html`<p>${store.past === null ? t.noCars : t.noCarsThen}</p>`}
      ${places.map((name) => {
        const car = byName.get(name);
        if (car === undefined) return html`<div class="cell" key=${name}></div>`;
        return html`<${Memo} key=${name} data=${drawn(car, chosen === name)} draw=${() => html`<${Tile} car=${car} />`} />`;
      })}
    </div>
    <div class=${shown ? "details" : "details empty"}>
      ${shown
        ? html`<${Memo} key=${shown.name} data=${drawn(shown, store.results)} draw=${() => html`<${Details} car=${shown} />`} />`
        : html`<p class="hint">${t.chooseCar}</p>`}
    </div>
  </div>`;
}
