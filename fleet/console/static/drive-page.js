// The drive page: hold to drive, modes, and everything else that the selected cars can do.

import {
  askBySocket, changed, command, isHeld, isMine, isRefused, isShared, lease, on, onTick, press, refusals, release, select, shownCars, store, who,
} from "./console.js";
import { driverOf, modeWords, motionWords, troublesOf } from "./car-words.js";
import { modes, motions, pad, t } from "./texts.js";
import { Battery, html, Rail, Refused, Results, SetChips, useEffect, useRef, useState } from "./ui.js";

const KEYS = {
  ArrowUp: "forward", ArrowDown: "back", ArrowLeft: "spin_left", ArrowRight: "spin_right",
  w: "forward", s: "back", a: "spin_left", d: "spin_right", q: "left", e: "right",
};
const TYPES_INTO = "input:not([type=checkbox]), select, textarea";
const STICK_THRESHOLD = 0.5;

const selected = () => {
  return shownCars().filter((car) => store.selected.has(car.name));
};
const names = () => selected().map((car) => car.name);

// ---------------------------------------------------------------- keys and gamepads, on this page only

function onKeyDown(event) {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const motion = KEYS[key];
  if (motion === undefined || event.ctrlKey || event.altKey || event.metaKey || event.target.closest(TYPES_INTO)) return;
  event.preventDefault();
  if (!event.repeat) press(motion, names(), `key ${event.code}`);
}

// Keys are told apart by their places (`code`): with another key held down, the same key may have another letter.
const onKeyUp = (event) => release(`key ${event.code}`);

function stickMotion() {
  for (const stick of navigator.getGamepads()) {
    if (stick === null) continue;
    const [x, y] = stick.axes;
    if (y < -STICK_THRESHOLD) return "forward";
    if (y > STICK_THRESHOLD) return "back";
    if (x < -STICK_THRESHOLD) return "spin_left";
    if (x > STICK_THRESHOLD) return "spin_right";
  }
  return null;
}

let stickBefore = null;
function onStick() {
  const motion = stickMotion();
  if (motion === stickBefore) return;
  // The stick's drive has ended: a person must let go of the stick before it begins another one.
  if (motion !== null && stickBefore !== null && !isHeld("stick")) return;
  stickBefore = motion;
  if (motion === null) release("stick");
  else press(motion, names(), "stick");
}

function useDriving() {
  useEffect(() => {
    window.addEventListener("keydown", onKeyDown);
    window.addEventListener("keyup", onKeyUp);
    const off = onTick(onStick);
    return () => {
      release();
      window.removeEventListener("keydown", onKeyDown);
      window.removeEventListener("keyup", onKeyUp);
      off();
    };
  }, []);
}

// ---------------------------------------------------------------- the delay

const PING_INTERVAL_MS = 1000;
// The console ends a drive if the page's echoes of its ticks are older than 300 ms. Half of that is a warning.
const LONG_DELAY_MS = 150;
let ping = null; // the ping that has no answer yet: {id, at}
let delay_ms = null;
on("pong", (message) => {
  if (message.id !== ping?.id) return false;
  delay_ms = Math.round(performance.now() - ping.at);
  ping = null;
});

// The time of a message to the console and back. While no answer comes it grows.
function measureDelay() {
  if (ping === null || !store.connected) ping = { id: askBySocket("ping"), at: performance.now() };
  else delay_ms = Math.round(performance.now() - ping.at);
}

function useDelay() {
  useEffect(() => {
    [ping, delay_ms] = [null, null];
    measureDelay();
    const timer = setInterval(measureDelay, PING_INTERVAL_MS);
    return () => clearInterval(timer);
  }, []);
}

// ---------------------------------------------------------------- the parts

// A button that was pressed with the mouse does not get the focus, so that Space afterwards stops, and does not drive.
const prevent = (event) => event.preventDefault();

function PadButton({ motion, symbol, words, letter }) {
  const source = `pad ${motion}`;
  const down = (event) => {
    if (event.button !== 0) return;
    document.activeElement?.blur();
    event.currentTarget.setPointerCapture(event.pointerId);
    press(motion, names(), source);
  };
  const up = () => release(source);
  // Space and Enter on the button are held, too. The browser's own click does nothing.
  const isHoldKey = (event) => event.key === " " || event.key === "Enter";
  const keyDown = (event) => {
    if (!isHoldKey(event)) return;
    event.preventDefault();
    if (!event.repeat) press(motion, names(), source);
  };
  const keyUp = (event) => isHoldKey(event) && up();
  const held = store.press?.motion === motion;
  // `aria-disabled`, not `disabled`: a button that is disabled while it is held would lose the release.
  return html`<button class=${held ? "pad held" : "pad"} data-motion=${motion} aria-disabled=${isRefused("move", names())} aria-label=${`${words}, hold`}
    aria-pressed=${held} onPointerDown=${down} onPointerUp=${up} onPointerCancel=${up} onLostPointerCapture=${up}
    onKeyDown=${keyDown} onKeyUp=${keyUp} onBlur=${up} onMouseDown=${prevent} onContextMenu=${prevent}>
    <span class="arrow" aria-hidden="true">${symbol}</span><span class="pad-words">${words} <kbd>${letter}</kbd></span>
  </button>`;
}

const Pad = () => html`<div class="pads">
    ${pad.map(([motion, symbol, words, letter]) => html`<${PadButton} ...${{ motion, symbol, words, letter }} />`)}
  </div>
  <p class="driving" role="status">${store.press ? t.driving(motions[store.press.motion], store.press.cars) : ""}</p>
  <p class="hint" id="pad-hint">${t.padHint}</p>`;

function choose(names) {
  select(names);
  release();
  changed();
}

const Chip = ({ car }) => {
  const chosen = store.selected.has(car.name);
  const toggle = () => choose(chosen ? [...store.selected].filter((name) => name !== car.name) : [...store.selected, car.name]);
  return html`<label class=${chosen ? "car-chip car chosen" : "car-chip car"} style=${{ "--car": car.color }}>
    <input type="checkbox" name=${`select-${car.name}`} checked=${chosen} onChange=${toggle} />
    <span aria-hidden="true">${chosen ? "✓" : "+"}</span> ${car.name}
  </label>`;
};

// A person with cars of their own sees those. The cars of others are one press away, because nobody here drives them.
function Selection({ cars }) {
  const chooser = useRef(null);
  // A phone has room for a few chips: the chosen one shall be among them.
  useEffect(() => chooser.current.querySelector(".chosen")?.scrollIntoView({ block: "nearest", inline: "center" }), []);
  const shared = isShared(cars.map((car) => car.name));
  const [own, others] = shared ? [cars.filter((car) => isMine(car.name)), cars.filter((car) => !isMine(car.name))] : [cars, []];
  const chosen = names();
  const isOn = (set) => set.cars.length === chosen.length && chosen.every((name) => set.cars.includes(name));
  return html`<div class="chooser" ref=${chooser}>
    <${SetChips} cars=${own} label=${t.selectSet} isOn=${isOn} onPress=${(set) => choose(isOn(set) ? [] : set.cars)} />
    <${Rail} name="car-chips" label=${t.select}>${own.map((car) => html`<${Chip} key=${car.name} car=${car} />`)}<//>
    ${others.length > 0 &&
    html`<details class="others" open=${others.some((car) => store.selected.has(car.name))}>
      <summary>${t.otherCars(others.length)}</summary>
      <${Rail} name="car-chips" label=${t.otherCars(others.length)}>${others.map((car) => html`<${Chip} key=${car.name} car=${car} />`)}<//>
    </details>`}
  </div>`;
}

// What a driver looks at while the thumb is on the pad.
const FULL_BAR_M = 2; // what the bar of the distance can show
const Distance = ({ range_m }) => html`<span class="gauge"><span class="dim">${t.distance}</span> <strong>${
  range_m === undefined ? t.noReading : range_m === null ? t.noEcho : t.metres(range_m)
}</strong><span class="bar wide-bar" aria-hidden="true"><span style=${{ transform: `scaleX(${Math.min(1, (range_m ?? 0) / FULL_BAR_M)})` }}></span></span></span>`;

const Lights = ({ values }) => html`<span class="lights" aria-hidden="true">${values.map((on) => html`<span class=${on ? "on" : ""}></span>`)}</span>`;
// Lights in the order of the sensors, and their words. `unseen` hides the words, if the lights say enough.
const Sides = ({ name, values, words, isAlarm, unseen }) => html`<span class=${isAlarm && values?.some(Boolean) ? "gauge bad" : "gauge"}
  ><span class="dim">${name}</span> ${values ? html`<${Lights} values=${values} /> <strong class=${unseen ? "unseen" : ""}>${words(values)}</strong>` : html`<strong>${t.noReading}</strong>`}</span>`;
const named = (names, values) => names.filter((_, at) => values[at]);

const stateOf = (car) => {
  const driver = driverOf(car);
  return [driver && t.drivenMark(who(driver)), motionWords(car), modeWords(car.mode.asked), !driver && car.hold !== null && t.boardHeld(who(car.hold))].filter(Boolean).join(" · ");
};
const Live = ({ cars }) => html`<section class="live" aria-label=${t.live}>
  <p class="gauge delay"><span class="dim">${t.delay}</span>${" "}
    <strong data-delay=${delay_ms} class=${delay_ms !== null && delay_ms > LONG_DELAY_MS ? "bad" : ""}>${delay_ms === null ? t.noReading : t.delayOf(delay_ms)}</strong></p>
  <ul class="plain">
    ${cars.map(
      (car) => html`<li key=${car.name} class="car" data-live=${car.name} style=${{ "--car": car.color }}>
        <strong>${car.name}</strong>
        <span class="live-state"><span class="bad" data-wrong>${troublesOf(car).map((each) => `⚠ ${each.words} `)}</span><span class="dim">${stateOf(car)}</span></span>
        <${Distance} range_m=${car.range_m} />
        <${Sides} name=${t.obstacle} values=${car.obstacle} words=${(values) => t.seesObstacle(named(t.sideNames, values))} isAlarm />
        <${Sides} name=${t.line} values=${car.line} words=${(values) => t.seesLine(named(t.lineNames, values))} unseen />
        <span class="gauge"><span class="dim">${t.battery}</span> <${Battery} battery=${car.gateway ? car.battery : undefined} /></span>
      </li>`,
    )}
  </ul>
</section>`;

const Leases = ({ cars }) => html`<section>
  <h2>${t.lease}</h2>
  <ul class="plain">
    ${cars.map(
      (car) => html`<li key=${car.name}>
        <strong>${car.name}</strong>: ${car.lease ? t.leaseOf(who(car.lease.holder), car.lease.kind) : t.nobody}
        ${car.lease?.holder === store.hello?.sender
          ? html`<button onClick=${() => lease("give_back", [car.name])} aria-label=${`${t.giveBack} ${car.name}`}>${t.giveBack}</button>`
          : html`<button disabled=${isRefused("take", [car.name])} onClick=${() => lease("take", [car.name])}
              aria-label=${`${t.take} ${car.name}`}>${t.take}</button>`}
        <${Refused} words=${refusals("take", [car.name])} />
      </li>`,
    )}
  </ul>
</section>`;

const LEND_MINUTES = [1, 5, 10, 30, 60];
function Lend({ cars }) {
  const people = [...new Set(cars.flatMap((car) => car.people))].sort();
  const [to, setTo] = useState("");
  const [minutes, setMinutes] = useState(10);
  const chosen = people.includes(to) ? to : (people[0] ?? to);
  if (isRefused("lend", names())) return null; // a pupil may not lend cars
  return html`<section data-control="lend">
    <h2>${t.lend}</h2>
    <fieldset class="bare controls">
      <label>${t.lendTo}${" "}
        ${people.length > 0
          ? html`<select name="to" value=${chosen} onChange=${(event) => setTo(event.target.value)}>
              ${people.map((name) => html`<option key=${name}>${name}</option>`)}
            </select>`
          : html`<input name="to" maxlength="32" value=${to} onInput=${(event) => setTo(event.target.value)} />`}</label>
      <label>${t.lendFor}${" "}
        <select name="minutes" value=${minutes} onChange=${(event) => setMinutes(Number(event.target.value))}>
          ${LEND_MINUTES.map((count) => html`<option key=${count} value=${count}>${t.minutes(count)}</option>`)}
        </select></label>
      <button data-do="lend" onClick=${() => command("lend", names(), { to: chosen, duration_s: minutes * 60 })}>${t.lend}</button>
    </fieldset>
    <${Refused} words=${refusals("lend", names())} />
  </section>`;
}

const ACTS = ["led", "light", "whistle"];

// A control that all chosen cars have. Controls that some of them lack are in `Lacking`.
const lacking = (cars, needs) => cars.filter((car) => needs in car.cannot);
function Offer({ title, needs, cars, children }) {
  if (lacking(cars, needs).length > 0) return null;
  return html`<section data-control=${needs}>
    <h2>${title}</h2>
    <fieldset class="bare" disabled=${isRefused(ACTS.includes(needs) ? "act" : "move", names())}>${children}</fieldset>
  </section>`;
}

// What not all chosen cars can do, in one line. Unfolded, it says which car lacks what, and why.
const OFFERS = [
  [t.mode, "mode"], [t.speed, "speed"], [t.led, "led"], [t.light, "light"], [t.sounds, "whistle"], [t.servo, "servo_deg"],
  [t.servoNames.vertical, "servo_vertical"], [t.servoNames.horizontal, "servo_horizontal"], [t.arm, "arm"], [t.fan, "fan"],
];
function Lacking({ cars }) {
  const missing = OFFERS.filter(([, needs]) => lacking(cars, needs).length > 0);
  if (missing.length === 0) return null;
  return html`<details class="lacking">
    <summary>${t.lacking(cars.map((car) => car.name), missing.map(([title]) => title))}</summary>
    <ul class="plain">
      ${missing.map(([title, needs]) => html`<li key=${needs} data-control=${needs}><strong>${title}</strong>
        ${lacking(cars, needs).map((car) => html`<p class="cannot" key=${car.name}>${t.cannot(car.name, car.cannot[needs])}</p>`)}</li>`)}
    </ul>
  </details>`;
}

// What forbids driving forbids the other controls, too: it is said once, here.
function Driver({ cars }) {
  const cannot = lacking(cars, "drive");
  return html`<section class="driver" data-control="drive" aria-label=${t.padLabel}>
    ${cannot.length === 0
      ? html`<${Pad} /><${Refused} words=${refusals("move", names())} />`
      : cannot.map((car) => html`<p class="cannot" key=${car.name}>${t.cannot(car.name, car.cannot.drive)}</p>`)}
  </section>`;
}

const common = (cars, field) => cars[0][field].filter((word) => cars.every((car) => car[field].includes(word)));

const Modes = ({ cars }) => html`<ul class="modes">
  ${common(cars, "modes").map((mode) => {
    const [name, words] = modes[mode] ?? [mode, modes.unknown[1]];
    const asked = cars.every((car) => car.mode.asked === mode);
    return html`<li key=${mode}>
      <button data-mode=${mode} aria-pressed=${asked} aria-describedby=${`mode-${mode}`}
        onClick=${() => command("mode", names(), { mode })}>${name}</button>
      <span id=${`mode-${mode}`}>${words}</span>
    </li>`;
  })}
</ul>`;

function Led() {
  const [color, setColor] = useState("#00ff00");
  const rgb = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));
  return html`<div class="controls">
    <input type="color" aria-label=${t.led} value=${color} onInput=${(event) => setColor(event.target.value)} />
    <button data-do="led" onClick=${() => command("led", names(), { rgb })}>${t.setLed}</button>
  </div>`;
}

const LightColors = ({ cars }) => html`<div class="controls">
  ${common(cars, "lights").map(
    (light) => html`<button key=${light} data-light=${light} onClick=${() => command("light", names(), { light })}>${light}</button>`,
  )}
</div>`;

const Speed = ({ cars }) => html`<div class="controls">
    <button data-do="slower" onClick=${() => command("speed", names(), { step: "down" })}>${t.slower}</button>
    <button data-do="faster" onClick=${() => command("speed", names(), { step: "up" })}>${t.faster}</button>
  </div>
  ${cars.map(
    (car) =>
      car.motion.speed !== null &&
      html`<p key=${car.name}>
        <meter min="0" max="1" value=${car.motion.speed} aria-label=${`${t.speed} ${car.name}`}></meter>
        ${car.name}: ${t.speedEstimate(car.motion.speed)}
      </p>`,
  )}`;

function ServoAngle() {
  const [deg, setDeg] = useState(90);
  return html`<div class="controls">
    <label>0° <input type="range" name="servo" min="0" max="180" value=${deg} aria-label=${t.servo}
      onInput=${(event) => setDeg(event.target.valueAsNumber)}
      onChange=${(event) => command("servo", names(), { deg: event.target.valueAsNumber })} /> 180°</label>
    <output>${deg}°</output>
    <p class="hint">${t.servoRange}</p>
  </div>`;
}

const ServoSteps = ({ servo, actions }) => html`<div class="controls">
  ${actions.map(
    (action) => html`<button key=${action} onClick=${() => command("servo", names(), { servo, action })}
      aria-label=${`${t.servoNames[servo]} ${t.servoStep[action]}`}>${t.servoStep[action]}</button>`,
  )}
</div>`;

function Arm() {
  const [joints, setJoints] = useState([90, 90, 90, 90, 90, 90]);
  const set = (index, deg) => setJoints(joints.map((before, at) => (at === index ? deg : before)));
  return html`<div class="joints">
      ${joints.map(
        (deg, index) => html`<label key=${index}>${t.joint(index + 1)}
          <input type="range" min="0" max="180" value=${deg} onInput=${(event) => set(index, event.target.valueAsNumber)} />
          <output>${deg}°</output></label>`,
      )}
    </div>
    <button data-do="arm" onClick=${() => command("arm", names(), { joint_deg: joints })}>${t.moveArm}</button>`;
}

const Fan = ({ cars }) => html`<button data-do="fan" onClick=${() => command("fan", names())}>${t.toggleFan}</button>
  ${cars.map((car) => html`<p key=${car.name} class="hint">${car.name}: ${t.fanState(car.motion.fan)}</p>`)}`;

const Controls = ({ cars }) => html`
  <${Leases} cars=${cars} />
  <${Offer} title=${t.mode} needs="mode" cars=${cars}><${Modes} cars=${cars} /><//>
  <${Offer} title=${t.speed} needs="speed" cars=${cars}><${Speed} cars=${cars} /><//>
  <${Offer} title=${t.led} needs="led" cars=${cars}><${Led} /><//>
  <${Offer} title=${t.light} needs="light" cars=${cars}><${LightColors} cars=${cars} /><//>
  <${Offer} title=${t.sounds} needs="whistle" cars=${cars}>
    <div class="controls">
      <button data-do="whistle" onClick=${() => command("whistle", names())}>${t.whistle}</button>
      <button data-do="find" onClick=${() => command("find", names())}>${t.identify}</button>
    </div>
  <//>
  <${Offer} title=${t.servo} needs="servo_deg" cars=${cars}><${ServoAngle} /><//>
  <${Offer} title=${t.servoNames.vertical} needs="servo_vertical" cars=${cars}>
    <${ServoSteps} servo="vertical" actions=${["up", "down", "reset"]} />
  <//>
  <${Offer} title=${t.servoNames.horizontal} needs="servo_horizontal" cars=${cars}>
    <${ServoSteps} servo="horizontal" actions=${["left", "right", "reset"]} />
  <//>
  <${Offer} title=${t.arm} needs="arm" cars=${cars}><${Arm} /><//>
  <${Offer} title=${t.fan} needs="fan" cars=${cars}><${Fan} cars=${cars} /><//>
  <${Lend} cars=${cars} />
  <${Lacking} cars=${cars} />
`;

export function DrivePage({ cars }) {
  useDriving();
  useDelay();
  const driven = selected();
  return html`<div class="drive">
    <h1 class="unseen">${t.drive}</h1>
    <${Selection} cars=${cars} />
    <${Driver} cars=${driven} />
    <${Live} cars=${driven} />
    <div class="drive-controls">
      <${Results} />
      ${driven.length === 0 && html`<p>${t.selectHint}</p>`}
      ${driven.some((car) => isMine(car.name)) && html`<${Controls} cars=${driven} />`}
    </div>
  </div>`;
}
