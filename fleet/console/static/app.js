// The page: navigation, the STOP bar in the same place on every page, and the keys that stop.

import { carsInPlace, changed, clock, estopAll, isReady, pauseAll, setTexts, stopAll, store, subscribe, unpause, unsentStop, when, who } from "./console.js";
import { goLive, jump, route } from "./past.js";
import { DrivePage } from "./drive-page.js";
import { FleetPage } from "./fleet-page.js";
import { InspectPage } from "./inspect-page.js";
import { PeoplePage } from "./people-page.js";
import { PlanPage } from "./plan-page.js";
import { SessionsPage } from "./sessions-page.js";
import { SetupPage } from "./setup-page.js";
import { modes, stopStates, t } from "./texts.js";
import { Component, html, Icon, Refused, render, useEffect, useRef, useState, Verdict } from "./ui.js";

const SHOW_REPORT_MS = 30_000;
const SAME_PRESS_MS = 1000;

// These pages are loaded only when somebody opens them: uPlot (for the plots) is three times as large as all else.
const loadPlots = async () => {
  const looks = document.createElement("link");
  Object.assign(looks, { rel: "stylesheet", href: "/static/vendor/uplot.css" });
  document.head.append(looks);
  return (await import("./plots-page.js")).PlotsPage;
};
const loadMap = async () => (await import("./map-page.js")).MapPage;
const loadBoard = async () => (await import("./board-page.js")).BoardPage;
const loadTime = async () => (await import("./time-page.js")).TimePage;
function later(title, load) {
  let Page = null;
  return function Later({ cars }) {
    const [failed, setFailed] = useState(false);
    const [, setLoaded] = useState(Page !== null);
    useEffect(() => {
      if (Page !== null) return;
      load().then(
        (page) => {
          Page = page;
          setLoaded(true);
        },
        () => setFailed(true),
      );
    }, []);
    if (Page !== null) return html`<${Page} cars=${cars} />`;
    return failed ? html`<h1>${title}</h1><p>${t.unreachable}</p>` : html`<p>${t.loading}</p>`;
  };
}

// Each page with the drawing of its tab, 24 by 24: letters that look like symbols differ from phone to phone.
const PAGES = {
  "#/": [t.fleet, FleetPage, "M4 4h6v6H4zM14 4h6v6h-6zM4 14h6v6H4zM14 14h6v6h-6z"],
  "#/drive": [t.drive, DrivePage, "M12 3v18M3 12h18M9 6l3-3 3 3M9 18l3 3 3-3M6 9l-3 3 3 3M18 9l3 3-3 3"],
  "#/plan": [t.plan, PlanPage, "M9 6h11M9 12h11M9 18h11M4 6h1M4 12h1M4 18h1"],
  "#/map": [t.map, later(t.map, loadMap), "M3 6l6-2 6 2 6-2v14l-6 2-6-2-6 2zM9 4v14M15 6v14"],
  "#/plots": [t.plots, later(t.plots, loadPlots), "M4 4v16h16M7 15l4-5 3 3 5-7"],
  "#/time": [t.time, later(t.time, loadTime), "M3 12h18M7 8v8M12 9.500v5M17 8v8"],
  "#/inspect": [t.inspect, InspectPage, "M11 4a7 7 0 1 0 0 14 7 7 0 0 0 0-14zM16 16l5 5"],
  "#/people": [t.people, PeoplePage, "M12 4a4 4 0 1 0 0 8 4 4 0 0 0 0-8zM4 21c0-4 3-6 8-6s8 2 8 6"],
  "#/board": [t.board, later(t.board, loadBoard), "M3 4h18v12H3zM12 16v5M8 21h8"],
  "#/sessions": [t.sessions, SessionsPage, "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18zM12 10a2 2 0 1 0 0 4 2 2 0 0 0 0-4z"],
  "#/setup": [t.setup, SetupPage, "M4 7h9M17 7h3M4 17h3M11 17h9M15 5a2 2 0 1 0 0 4 2 2 0 0 0 0-4zM9 15a2 2 0 1 0 0 4 2 2 0 0 0 0-4z"],
};
const DRAWINGS = {
  more: "M5 11v2M12 11v2M19 11v2",
  stop: "M8 3h8l5 5v8l-5 5H8l-5-5V8z",
  pause: "M8 5v14M16 5v14",
  estop: "M12 3l9.500 17h-19zM12 10v4M12 17v.500",
};

// A device of a class that nobody has assigned yet.
const isGuest = () => store.hello?.person.rank === "guest";

// A phone that is held upright has room for five tabs. The last one leads to the other pages.
const narrow = matchMedia("(max-width: 34rem) and (orientation: portrait)");
narrow.addEventListener("change", changed);
const MORE = "#/more";
const FIRST_TABS = 4;
const tabs = () => (isGuest() ? GUEST_TABS : narrow.matches ? FEW_TABS : ALL_TABS);
const MorePage = () => html`<h1>${t.more}</h1>
  <ul class="plain more">
    ${Object.entries(PAGES).slice(FIRST_TABS).map(
      ([to, [name, , drawing]]) => html`<li key=${to}><a class="button" href=${to}><${Icon} path=${drawing} /> ${name}</a></li>`,
    )}
  </ul>`;

const ALL_TABS = Object.entries(PAGES);
const GUEST_TABS = ["#/", "#/map", "#/plots", "#/time", "#/board"].map((to) => [to, PAGES[to]]); // to watch
const FEW_TABS = [...ALL_TABS.slice(0, FIRST_TABS), [MORE, [t.more, MorePage, DRAWINGS.more]]];

// ---------------------------------------------------------------- STOP

window.addEventListener(
  "keydown",
  (event) => {
    const focus = document.activeElement;
    const free = focus === null || focus === document.body || focus.id === "stop" || focus.id === "content";
    if (event.key !== "Escape" && !(event.key === " " && free)) return;
    event.preventDefault();
    if (!event.repeat) stopAll();
  },
  { capture: true },
);

// After a click with the mouse no button has the focus, so that Space stops. After a press by keyboard the focus stays.
window.addEventListener("click", (event) => {
  const focus = document.activeElement;
  if (event.pointerType === "mouse" && focus?.matches("button, summary, a, input[type=checkbox]")) focus.blur();
});

let pointerAt = -Infinity;
const onStopDown = () => {
  pointerAt = performance.now();
  stopAll();
};
// A screen reader sends a click alone. The click after a pointer is the same press.
const onStopClick = () => {
  if (performance.now() - pointerAt > SAME_PRESS_MS) stopAll();
};

const stopDetail = (car) =>
  car.at_ms === null ? "" : t.stopDetail(car.state, clock(car.at_ms), car.took_s, clock(car.moved_at_ms ?? car.at_ms));

const SAID_TWICE = /^NOT CONFIRMED: /;
// In a folded report, a failed car is only its name beside the line that says how many failed.
const Stopped = ({ car, isShort }) => html`<li class=${`chip stop-${car.state}`} data-stop=${car.name} title=${car.words}>
  ${isShort
    ? html`<span class="bad"><span aria-hidden="true">${stopStates.failed[0]}</span> ${car.name}<span class="unseen"> ${stopStates.failed[1]}</span></span>`
    : html`<strong>${car.name}</strong> <${Verdict} table=${stopStates} name=${car.state} detail=${stopDetail(car)} />
        ${car.state === "failed" ? ` ${car.words.replace(SAID_TWICE, "")}` : ""}`}
</li>`;

// The report lies over the content. So the content gets the report's height as padding: its last button can be scrolled
// into view. Only the content has this property: on the root it would make a slow phone style the whole page again.
const cover = (height) => document.getElementById("content")?.style.setProperty("--covered", height);
const covered = new ResizeObserver(([{ target }]) => cover(`${target.offsetHeight}px`));
function noteReport(report) {
  covered.disconnect();
  cover("");
  if (report !== null) covered.observe(report);
}

// The report of the newest STOP. Folded, it is one line that covers no pad. The failed cars are always named.
let reportSeen = [0, 0];
function Report({ report }) {
  const [unfolded, setUnfolded] = useState(0); // the number of the report that is shown car by car
  if (report === null || (report.cars.length === 0 && report.closed > 0)) return null;
  if (reportSeen[0] !== report.number) reportSeen = [report.number, performance.now()];
  const failed = report.cars.filter((car) => car.state === "failed");
  if (report.over && failed.length === 0 && performance.now() - reportSeen[1] > SHOW_REPORT_MS) return null;
  const words = t.stopSummary(report.cars, report.closed);
  const isUnfolded = unfolded === report.number;
  const line = failed.length > 0 && !isUnfolded ? t.stopFailed(failed.length) : words;
  const others = isUnfolded ? report.cars.filter((car) => car.state !== "failed") : [];
  return html`<div class="report" data-report=${report.number} ref=${noteReport}>
    <p class="unseen" role="status">${t.stopVerbs[report.verb]}: ${words}</p>
    <button class="report-line" aria-expanded=${isUnfolded} onClick=${() => setUnfolded(isUnfolded ? 0 : report.number)}>
      <span><strong>${t.stopVerbs[report.verb]}</strong>: ${line}</span> <span aria-hidden="true">${isUnfolded ? "▴" : "▾"}</span>
    </button>
    <ul class="plain chips">${[...failed, ...others].map((car) => html`<${Stopped} key=${car.name} car=${car} isShort=${!isUnfolded} />`)}</ul>
  </div>`;
}

function StopBar() {
  const [asking, setAsking] = useState(null); // estop, pause
  const [why, setWhy] = useState("");
  const act = () => {
    if (asking === "estop") estopAll(why);
    else pauseAll(why);
    setAsking(null);
    setWhy("");
  };
  const toggle = (what) => setAsking(asking === what ? null : what);
  // A pause is for leads. Until the rights are known, its button's place is empty: STOP must not shrink under a finger.
  const mayPause = store.rights === null || store.rights.pause === "";
  const onWhyKey = (event) => event.key === "Enter" && !event.repeat && !event.isComposing && act();
  return html`<section class="stopbar" aria-label="STOP">
    ${asking && (mayPause || asking === "estop") &&
    html`<div class="estop" data-asking=${asking}>
      <p>${asking === "estop" ? t.estopEffect : t.pauseEffect}</p>
      <label>${asking === "estop" ? t.estopWhy : t.pauseWhy} <input name="why" maxlength="200" value=${why} onInput=${(event) => setWhy(event.target.value)} onKeyDown=${onWhyKey} /></label>
      <button class="danger" onClick=${act}>
        ${asking === "estop" ? t.estopNow : t.pauseNow}</button>
      <button onClick=${() => setAsking(null)}>${t.cancel}</button>
    </div>`}
    <div class="stop-row">
      <button id="stop" onPointerDown=${onStopDown} onClick=${onStopClick}>
        <${Icon} path=${DRAWINGS.stop} /><span>${store.unpaired === "revoked" ? t.stopDead : html`${t.stop} <small class="keys">${t.stopKeys}</small><small>${t.stopMeans}</small>`}</span>
      </button>
      ${mayPause &&
      html`<button id="pause" class=${store.rights === null ? "later" : ""} aria-expanded=${asking === "pause"} onClick=${() => toggle("pause")}>
        <span><${Icon} path=${DRAWINGS.pause} /> ${t.pause}</span><small>${t.pauseMeans}</small></button>`}
      ${!isGuest() && html`<button id="estop" aria-expanded=${asking === "estop"} onClick=${() => toggle("estop")}><span><${Icon} path=${DRAWINGS.estop} /> ${t.estop}</span><small>${t.estopMeans}</small></button>`}
    </div>
  </section>`;
}

// ---------------------------------------------------------------- the page

const Banner = ({ words }) => html`<p class="banner" role="alert">${words}</p>`;

function Paused({ cars }) {
  const pause = cars.find((car) => car.pause)?.pause;
  if (pause === undefined) return null;
  return html`<div class="banner" role="alert" data-paused>
    ${t.paused(who(pause.by), pause.why)}${" "}
    <button disabled=${store.rights.unpause !== ""} title=${store.rights.unpause} onClick=${unpause}>${t.unpause}</button>
    ${store.rights.unpause && html`<${Refused} words=${[store.rights.unpause]} />`}
  </div>`;
}

// Above the content on a large screen, a tab bar at the bottom of a phone.
class Navigation extends Component {
  shouldComponentUpdate(next) {
    return next.here !== this.props.here || next.shown !== this.props.shown;
  }
  render({ here, shown }) {
    return html`<${Tabs} here=${here} shown=${shown} />`;
  }
}
function Tabs({ here, shown }) {
  const bar = useRef(null);
  const current = shown.some(([to]) => to === here) ? here : MORE;
  useEffect(() => bar.current.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest", inline: "nearest" }), [current]);
  return html`<nav aria-label="Pages" ref=${bar}>
    ${shown.map(
      ([to, [name, , drawing]]) => html`<a key=${to} href=${to} aria-current=${to === here ? "page" : to === current ? "true" : undefined}
        ><${Icon} path=${drawing} />${name}</a>`,
    )}
  </nav>`;
}

// How old the shown data is, and why the console does not let this page in.
function Connection() {
  const { state } = store;
  const [symbol, kind, words] =
    state === null || store.unpaired
      ? ["◌", "off", store.unpaired ? t.connection.unpaired : t.connection.none]
      : store.lost || !store.connected
        ? ["⚠", "old", t.connection.old(t.ago(store.silent_s))]
        : !state.hub
          ? ["⚠", "bus", t.connection.bus]
          : ["●", "live", store.past === null ? t.connection.live : t.connection.past];
  return html`<span class=${`connection ${kind === "live" ? "" : "bad"}`} data-connection=${kind}><span aria-hidden="true">${symbol}</span> ${words}</span>`;
}

// Shown on every page while somebody looks back, with the way back to now.
function PastBar() {
  const { past } = store;
  if (past === null) return null;
  const isComing = past.shown === null || past.shown.at_ms !== past.at_ms;
  return html`<div class="past-bar" role="status" data-past-at=${past.at_ms} data-coming=${isComing}>
    <strong><span class="dim">${t.pastIs}</span> ${t.pastOf(past.at_ms > 0 ? when({ at_ms: past.at_ms, zone_s: store.state.zone_s }, 10) : "")}</strong>
    <button onClick=${() => jump(past.session, past.at_ms - 10_000)} aria-label=${t.timeBack(10)}>−10 s</button>
    <button onClick=${() => jump(past.session, past.at_ms + 10_000)} aria-label=${t.timeOn(10)}>+10 s</button>
    <button class="main" data-live-now onClick=${goLive}>${t.backToLive}<span class="to-now">${t.backToNow}</span></button>
    <span class="dim">${t.pastStops}</span>
    ${past.words && html`<span class="bad">⚠ ${past.words}</span>`}
  </div>`;
}

class App extends Component {
  componentDidMount() {
    subscribe(() => this.setState({}));
    window.addEventListener("hashchange", () => this.setState({}));
  }
  render() {
    const { state } = store;
    const asked = route() === MORE ? [t.more, MorePage] : PAGES[route()];
    const here = asked === undefined ? "#/" : route();
    const [title, Page] = asked ?? PAGES["#/"];
    document.title = `${store.past === null ? "" : `${t.past}: `}${title} – ${t.title}`;
    document.documentElement.toggleAttribute("data-past", store.past !== null);
    return html`
      <a class="skip" href="#content" onClick=${(event) => {
        event.preventDefault();
        document.getElementById("content").focus();
      }}>${t.skip}</a>
      <${Navigation} here=${here} shown=${tabs()} />
      <header class="top">
        <span class="person">${store.hello && store.rights ? t.youAre(store.hello.person.name, store.rights.lead) : ""}</span>
        <${Connection} />
        <span class="fleet-name">${state?.fleet ?? ""}</span>
      </header>
      <main id="content" tabindex="-1" class=${here === "#/" ? "filled" : ""}>
        ${isReady() ? html`<${Page} key=${here} cars=${carsInPlace()} />` : html`<h1>${t.title}</h1><p>${t.connecting}</p>
          ${store.refusedWhy && html`<p class="bad" data-refused>${t.refusedWhy(store.refusedWhy)}</p>`}`}
      </main>
      <div class="messages"><div class="notices">
        ${isReady() && html`<${PastBar} />`}
        ${state !== null && (store.lost || !store.connected) && !store.unpaired && html`<${Banner} words=${t.consoleLost(store.refusedWhy)} />`}
        ${store.stopUnsent && unsentStop() !== "estop" && html`<${Banner} words=${t.stopUnsent} />`}
        ${unsentStop() && html`<${Banner} words=${t.unsentStops[unsentStop()]} />`}
        ${store.unpaired && html`<p class="banner" role="alert">${t.unpaired[store.unpaired]} <a href="/pair">${t.pairAgain}</a></p>`}
        ${state !== null && !state.hub && html`<${Banner} words=${t.hubLost} />`}
        ${isReady() && isGuest() && html`<p class="note guest" role="status" data-guest>${t.guest(store.hello.person.name)}</p>`}
        ${state?.unrecorded && html`<${Banner} words=${t.unrecorded(state.unrecorded)} />`}
        ${isReady() && html`<${Paused} cars=${state.cars} />`}
      </div>
      <${Report} report=${state?.stop ?? null} /></div>
      <${StopBar} />
    `;
  }
}

setTexts({ ...t, modes });
render(html`<${App} />`, document.getElementById("app"));
