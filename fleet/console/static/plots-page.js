// The plots page: up to four readings, each of several cars, over thirty seconds to ten minutes. A plot can be paused and
// zoomed: all plots then show the same time. Bands show what the cars did: modes on top, stops from top to bottom.

import { clock, on, shownNow, store, unwish, wish } from "./console.js";
import { liveSpans, showLanes } from "./lanes.js";
import { lanesOf, need, openSession } from "./past.js";
import { readings, t } from "./texts.js";
import { html, useEffect, useRef, useState } from "./ui.js";
import uPlot from "./vendor/uplot.js";

const PLOTS = 4;
// One slot for each two pixels or so: drawing costs the same whatever the rate and the time shown.
const SLOTS = 600;
// Drawing more often does not look smoother, and at 25 Hz uPlot's memory swings between 99 and 749 MB.
const DRAW_MS = 100;
const FIRST = ["sensor/range range_m", "sensor/battery voltage_v", "sensor/line left_inner", "state/motion speed"];

// The values of one plot in slots of equal time, so that all cars share the time axis.
class Grid {
  constructor(count, span_s) {
    this.slot_ms = (span_s * 1000) / SLOTS;
    this.rows = Array.from({ length: count }, () => new Map());
  }
  add(row, values) {
    for (const [at_ms, value] of values) this.rows[row].set(Math.floor(at_ms / this.slot_ms), value);
  }
  newest(row) {
    const slots = [...this.rows[row].keys()];
    return slots.length === 0 ? "–" : this.rows[row].get(Math.max(...slots));
  }
  // The values at the moment of the pause, so that nothing scrolls away under the eye.
  kept() {
    this.frozen ??= this.data();
    return this.frozen;
  }
  data() {
    this.frozen = null;
    const last = Math.floor(shownNow() / this.slot_ms);
    const slots = Array.from({ length: SLOTS }, (_, index) => last - SLOTS + 1 + index);
    for (const row of this.rows) {
      for (const slot of row.keys()) if (slot <= last - SLOTS) row.delete(slot);
    }
    return [slots.map((slot) => (slot * this.slot_ms) / 1000), ...this.rows.map((row) => slots.map((slot) => row.get(slot) ?? null))];
  }
}

// A date whose local time is that of the console: uPlot writes local times.
function consoleDate(at_s) {
  const there = new Date(1000 * (at_s + (store.state?.zone_s ?? 0)));
  const day = [there.getUTCFullYear(), there.getUTCMonth(), there.getUTCDate()];
  return new Date(...day, there.getUTCHours(), there.getUTCMinutes(), there.getUTCSeconds(), there.getUTCMilliseconds());
}

// What a reading is called, and its unit: "Distance, m".
const unitOf = (unit) => (unit && unit !== "1" ? `, ${unit}` : "");
const words = (topic, field) => readings[`${topic} ${field}`] ?? `${topic.split("/")[1]} ${field.replaceAll("_", " ")}`;
const titleOf = (offered, reading) => {
  const [topic, field] = reading.split(" ");
  const found = offered.find((each) => each[0] === topic && each[1] === field);
  return `${words(topic, field)}${unitOf(found?.[2])}`;
};

// If a car's color is hard to see on the background, its line is drawn in the color of the text, with gaps.
const MIN_CONTRAST = 1.6;
function brightness(color) {
  const parts = /^#/.test(color) ? [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16)) : color.match(/\d+/g).slice(0, 3).map(Number);
  const [red, green, blue] = parts.map((part) => (part / 255) ** 2.2);
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue + 0.05;
}
function lineOf(color, { ink, ground }) {
  const [one, other] = [brightness(color), brightness(ground)];
  return Math.max(one, other) / Math.min(one, other) >= MIN_CONTRAST ? { stroke: color } : { stroke: ink, dash: [8, 4] };
}

// Bands behind the lines: one strip for each car with its modes, and each stop over the whole height.
const STRIP = 7;
const MODE_SHADES = { manual: 0.25 }; // a car that stands and waits is pale
function drawBands(chart, cars, spans) {
  const { ctx, bbox } = chart;
  const ratio = devicePixelRatio;
  const x = (ms) => Math.min(bbox.left + bbox.width, Math.max(bbox.left, chart.valToPos(ms / 1000, "x", true)));
  const { min, max } = chart.scales.x;
  ctx.save();
  for (const { car, lane, begin, end, words: said, bad } of spans) {
    const row = cars.findIndex((each) => each.name === car);
    if (row < 0 || end / 1000 < min || begin / 1000 > max) continue;
    const width = Math.max(ratio, x(end) - x(begin));
    ctx.fillStyle = cars[row].color;
    if (lane === "mode") {
      ctx.globalAlpha = MODE_SHADES[said] ?? 1;
      ctx.fillRect(x(begin), bbox.top + row * STRIP * ratio, width, (STRIP - 1) * ratio);
    } else if (lane === "stop") {
      ctx.globalAlpha = bad ? 0.5 : 0.25;
      ctx.fillRect(x(begin), bbox.top, width, bbox.height);
    }
  }
  ctx.restore();
}

const shownSpans = () => (store.past === null ? liveSpans() : (lanesOf(store.past.session)?.spans ?? []));

function Plot({ title, cars, grid, view, onZoom }) {
  const area = useRef(null);
  const [newest, setNewest] = useState("");
  const names = cars.map((car) => car.name).join(" ");
  const shown = useRef(view);
  shown.current = view;
  const draw = useRef(() => {});
  useEffect(() => {
    const look = getComputedStyle(document.body);
    const looks = { ink: look.color, ground: look.backgroundColor };
    const axis = { stroke: looks.ink, grid: { stroke: "#8886", width: 1 } };
    const options = {
      width: area.current.clientWidth,
      height: area.current.clientHeight - 40,
      pxAlign: 0,
      tzDate: consoleDate,
      axes: [{ ...axis, space: 80, values: (_, splits) => splits.map((at) => clock(at * 1000)) }, { ...axis, label: title, labelSize: 24 }],
      scales: { x: { range: (_, min, max) => (shown.current === null ? [min, max] : [shown.current.from, shown.current.to]) } },
      series: [
        { label: t.plotTime, value: (_, at) => (at == null ? "–" : clock(at * 1000, 10)) },
        ...cars.map((car) => ({ label: car.name, ...lineOf(car.color, looks), width: 2, spanGaps: true, points: { show: false }, value: (_, value) => value ?? "–" })),
      ],
      cursor: { drag: { x: true, y: false, setScale: false }, focus: { prox: 16 }, points: { size: 7 } },
      legend: { live: true },
      hooks: {
        drawClear: [(chart) => drawBands(chart, cars, shownSpans())],
        setSelect: [
          (chart) => {
            const { left, width } = chart.select;
            if (width > 4) onZoom({ from: chart.posToVal(left, "x"), to: chart.posToVal(left + width, "x") });
            if (width > 0) chart.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
          },
        ],
      },
    };
    const chart = new uPlot(options, grid.data(), area.current);
    draw.current = () => chart.setData(shown.current === null ? grid.data() : grid.kept());
    const drawing = setInterval(() => {
      if (document.visibilityState !== "visible" || shown.current !== null) return;
      const box = area.current.getBoundingClientRect();
      if (box.bottom < 0 || box.top > innerHeight) return;
      draw.current();
    }, Math.max(DRAW_MS, grid.slot_ms)); // within a slot nothing moves
    // For who cannot see the lines: the newest values as text.
    const telling = setInterval(() => {
      setNewest(cars.map((car, row) => `${car.name} ${grid.newest(row)}`).join(", "));
    }, 1000);
    return () => {
      clearInterval(drawing);
      clearInterval(telling);
      chart.destroy();
    };
  }, [names, grid, title]);
  useEffect(() => draw.current(), [view]);
  return html`<div><div class="plot-area" ref=${area} role="img" aria-label=${title}></div><p class="newest">${t.plotValues(newest)}</p></div>`;
}

// The same time in all plots: null while they run.
function ViewControls({ view, span_s, setView }) {
  const now_s = () => shownNow() / 1000;
  const shown = () => view ?? { from: now_s() - span_s, to: now_s() };
  const zoom = (factor) => {
    const { from, to } = shown();
    const [middle, half] = [(from + to) / 2, ((to - from) / 2) * factor];
    setView({ from: middle - half, to: middle + half });
  };
  const move = (share) => {
    const { from, to } = shown();
    setView({ from: from + share * (to - from), to: to + share * (to - from) });
  };
  const button = (name, symbol, act) => html`<button data-view=${name} aria-label=${t.plotViews[name]} title=${t.plotViews[name]} onClick=${act}>${symbol}</button>`;
  return html`<div class="controls" role="group" aria-label=${t.plotView}>
    <button data-view="pause" aria-pressed=${view !== null} onClick=${() => setView(view === null ? shown() : null)}>${view === null ? t.plotPause : t.plotLive}</button>
    ${button("closer", "+", () => zoom(0.5))}${button("wider", "−", () => zoom(2))}
    ${button("earlier", "◀", () => move(-0.25))}${button("later", "▶", () => move(0.25))}
    <span class="hint">${view === null ? t.plotHint : t.plotShows(clock(view.from * 1000, 10), clock(view.to * 1000, 10))}</span>
  </div>`;
}

const isOf = (asked, readings, cars, span_s) =>
  asked !== null && asked.span_s === span_s && asked.series.length === readings.filter(Boolean).length * cars.length
  && asked.series.every(([car, topic, field]) => cars.some((each) => each.name === car) && readings.includes(`${topic} ${field}`));

export function PlotsPage({ cars }) {
  const [chosen, setChosen] = useState(() => new Set(store.selected.size ? store.selected : cars.slice(0, 3).map((car) => car.name)));
  const [span_s, setSpan] = useState(60);
  const [readings, setReadings] = useState(FIRST);
  const [grids, setGrids] = useState([]);
  const shown = cars.filter((car) => chosen.has(car.name));
  const names = shown.map((car) => car.name).join(" ");
  const [view, setView] = useState(null); // {from, to} in s, while paused
  const offered = store.hello?.plottable ?? [];
  const isPast = store.past !== null;
  // The values before the moment that is shown. null until those of the chosen series have come.
  const samples = isPast && isOf(store.past.shown, readings, shown, span_s) ? store.past.samples : null;
  useEffect(showLanes, []);

  useEffect(() => {
    const made = readings.map(() => new Grid(shown.length, span_s));
    const places = [];
    const series = [];
    readings.forEach((reading, at) => {
      if (reading === "") return;
      const [topic, field] = reading.split(" ");
      shown.forEach((car, row) => {
        places.push([at, row]);
        series.push([car.name, topic, field]);
      });
    });
    setGrids(made);
    setView(null);
    if (isPast) {
      for (const [number, some] of Object.entries(samples ?? {})) {
        const place = places[number];
        if (place !== undefined) made[place[0]].add(place[1], some);
      }
      need({ series, span_s });
      return () => {};
    }
    need({ series: [], span_s: 0 });
    on("samples", ({ values }) => {
      for (const [number, some] of Object.entries(values)) {
        const place = places[number];
        if (place !== undefined) made[place[0]].add(place[1], some);
      }
      return false;
    });
    const wanted = { t: "plot", series, since_s: span_s };
    if (series.length > 0) wish(wanted);
    else unwish("plot", wanted);
    return () => {
      on("samples", () => false);
      unwish("plot", { ...wanted, series: [] });
    };
  }, [names, span_s, readings.join("|"), isPast, samples]);
  useEffect(() => () => need({ series: [], span_s: 0 }), []);
  useEffect(() => {
    if (isPast) openSession(store.past.session);
  }, [store.past?.session]);

  const toggle = (name) => {
    const next = new Set(chosen);
    if (!next.delete(name)) next.add(name);
    setChosen(next);
  };
  return html`
    <h1>${t.plots}</h1>
    <fieldset class="selection">
      <legend>${t.plotCars}</legend>
      ${cars.map(
        (car) => html`<label key=${car.name} style=${{ "--car": car.color }}>
          <input type="checkbox" checked=${chosen.has(car.name)} onChange=${() => toggle(car.name)} /> ${car.name}</label>`,
      )}
      <label>${t.plotSpan} <select value=${span_s} onChange=${(event) => setSpan(Number(event.target.value))}>
        ${Object.entries(t.plotSpans).map(([seconds, words]) => html`<option key=${seconds} value=${seconds}>${words}</option>`)}
      </select></label>
    </fieldset>
    <${ViewControls} view=${view} span_s=${span_s} setView=${setView} />
    <p class="hint">${t.plotBands}</p>
    <div class="plots">
      ${readings.slice(0, PLOTS).map(
        (reading, at) => html`<div class="plot" key=${at} data-plot=${at}>
          <select aria-label=${t.plotReading(at + 1)} value=${reading}
            onChange=${(event) => setReadings(readings.map((before, index) => (index === at ? event.target.value : before)))}>
            <option value="">${t.plotNothing}</option>
            ${[...new Set(offered.map(([topic]) => topic))].map(
              (topic) => html`<optgroup key=${topic} label=${topic}>
                ${offered.filter((each) => each[0] === topic).map(
                  ([, field, unit]) => html`<option key=${field} value=${`${topic} ${field}`}>${words(topic, field)}${unitOf(unit)}</option>`,
                )}</optgroup>`,
            )}
          </select>
          ${reading !== "" && grids[at] && grids[at].rows.length === shown.length &&
          html`<${Plot} title=${titleOf(offered, reading)} cars=${shown} grid=${grids[at]} view=${view} onZoom=${setView} />`}
        </div>`,
      )}
    </div>
  `;
}
