// The plots page: up to four readings, each of several cars, over thirty seconds to ten minutes.

import { consoleNow, on, store, unwish, wish } from "./console.js";
import { t } from "./texts.js";
import { html, useEffect, useRef, useState } from "./ui.js";
import uPlot from "./vendor/uplot.js";

const PLOTS = 4;
// One slot for each two pixels or so: drawing costs the same whatever the rate and the time shown.
const SLOTS = 600;
// More often is not smoother, and at 25 Hz uPlot's memory swings between 99 and 749 MB.
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
  data() {
    const last = Math.floor(consoleNow() / this.slot_ms);
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

function Plot({ title, cars, grid }) {
  const area = useRef(null);
  const [newest, setNewest] = useState("");
  const names = cars.map((car) => car.name).join(" ");
  useEffect(() => {
    const ink = getComputedStyle(document.body).color;
    const axis = { stroke: ink, grid: { stroke: "#8886", width: 1 } };
    const options = {
      width: area.current.clientWidth,
      height: area.current.clientHeight - 40,
      pxAlign: 0,
      tzDate: consoleDate,
      axes: [axis, axis],
      series: [{}, ...cars.map((car) => ({ label: car.name, stroke: car.color, width: 2, spanGaps: true, points: { show: false } }))],
      cursor: { show: false },
      legend: { live: false },
    };
    const chart = new uPlot(options, grid.data(), area.current);
    const drawing = setInterval(() => {
      if (document.visibilityState !== "visible") return;
      const box = area.current.getBoundingClientRect();
      if (box.bottom < 0 || box.top > innerHeight) return;
      chart.setData(grid.data());
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
  }, [names, grid]);
  return html`<div><div class="plot-area" ref=${area} role="img" aria-label=${title}></div><p class="newest">${t.plotValues(newest)}</p></div>`;
}

export function PlotsPage({ cars }) {
  const [chosen, setChosen] = useState(() => new Set(store.selected.size ? store.selected : cars.slice(0, 3).map((car) => car.name)));
  const [span_s, setSpan] = useState(60);
  const [readings, setReadings] = useState(FIRST);
  const [grids, setGrids] = useState([]);
  const shown = cars.filter((car) => chosen.has(car.name));
  const names = shown.map((car) => car.name).join(" ");
  const offered = store.hello?.plottable ?? [];

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
  }, [names, span_s, readings.join("|")]);

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
    <div class="plots">
      ${readings.slice(0, PLOTS).map(
        (reading, at) => html`<div class="plot" key=${at} data-plot=${at}>
          <select aria-label=${t.plotReading(at + 1)} value=${reading}
            onChange=${(event) => setReadings(readings.map((before, index) => (index === at ? event.target.value : before)))}>
            <option value="">${t.plotNothing}</option>
            ${offered.map(
              ([topic, field, unit]) => html`<option key=${`${topic} ${field}`} value=${`${topic} ${field}`}>${topic} ${field}${unit && unit !== "1" ? `, ${unit}` : ""}</option>`,
            )}
          </select>
          ${reading !== "" && grids[at] && grids[at].rows.length === shown.length &&
          html`<${Plot} title=${reading} cars=${shown} grid=${grids[at]} />`}
        </div>`,
      )}
    </div>
  `;
}
