// The map: the floor from above with the cars, and a list of their places. They are the places of now, or of the moment that is shown.

import { driverOf, isLost, modeWords, motionWords, troublesOf } from "./car-words.js";
import { carsInPlace, clock, consoleNow, on, store, unwish, who, wish } from "./console.js";
import { boxOf, degrees, floorsOf, grown, placeOf, pointsOf } from "./map-geometry.js";
import { useMoments } from "./moments.js";
import { need } from "./past.js";
import { t } from "./texts.js";
import { Component, html, useEffect, useRef, useState } from "./ui.js";

const CAR_M = 0.22; // the length of a car
const LEAST_CAR_PX = 20;
const LETTER_PX = 14;

// What the console said last. `version` counts what is drawn.
let live = { places: {}, trails: {}, world: null, version: 0 };
const placesOf = (cars) => Object.fromEntries(Object.entries(cars).map(([car, place]) => [car, placeOf(place)]));
on("map", (message) => {
  const trails = grown(live.trails, message, consoleNow());
  live = { ...live, places: placesOf(message.cars), trails, version: live.version + 1 };
  return false; // the next state draws it: states come as often as this message
});
on("world", ({ world }) => {
  live = { ...live, world, version: live.version + 1 };
  return false;
});
const NOTHING = { places: {}, trails: {}, world: null, version: -1 };
let then = { of: null, view: NOTHING };
const shownMap = () => {
  if (store.past === null) return live;
  const { map } = store.past;
  if (then.of !== map) then = { of: map, view: map === null ? NOTHING : { places: placesOf(map.cars), trails: map.trails, world: map.world, version: then.view.version - 1 } };
  return then.view;
};

const path = (points, end = "") => `M${points.map(([x, y]) => `${x} ${-y}`).join("L")}${end}`;

const Ground = ({ world }) => html`<g class="ground">
  ${world.line.length > 0 && html`<path class="tape" d=${path(world.line, "Z")} />`}
  ${world.walls.map(([x1, y1, x2, y2], index) => html`<path class="wall" key=${index} d=${path([[x1, y1], [x2, y2]])} />`)}
  ${world.things.map(([name, x, y, yaw, radius, width, depth]) =>
    radius > 0
      ? html`<circle class="thing" key=${name} cx=${x} cy=${-y} r=${radius} />`
      : html`<rect class="thing" key=${name} x=${-width / 2} y=${-depth / 2} width=${width} height=${depth} transform=${`translate(${x} ${-y}) rotate(${-degrees(yaw)})`} />`,
  )}
  ${world.lamps.map(([name, x, y, isOn]) => html`<circle class=${`lamp-light ${isOn ? "is-on" : ""}`} key=${name} cx=${x} cy=${-y} r="0.06" />`)}
</g>`;

const isBad = (car) => troublesOf(car).length > 0;

// A car seen from above: its front is pointed.
const SHAPE = "M-0.5 -0.34L0.2 -0.34L0.5 0L0.2 0.34L-0.5 0.34Z";
const CarMark = ({ car, place, size, letter, isChosen }) => html`<g data-mark=${car.name}>
  <path class=${`mark-car ${place.age_s === null && !isLost(car) ? "" : "is-old"} ${isBad(car) ? "is-bad" : ""} ${isChosen ? "is-chosen" : ""}`} d=${SHAPE} style=${{ fill: car.color }}
    transform=${`translate(${place.x} ${-place.y}) rotate(${-degrees(place.yaw)}) scale(${size})`} />
  <text x=${place.x} y=${-place.y + size * 0.6 + letter} font-size=${letter}>${car.name}</text>
  ${isBad(car) && html`<text class="mark-trouble" x=${place.x} y=${-place.y + size * 0.6 + 2.1 * letter} font-size=${letter}>⚠ ${t.mapTroubles[troublesOf(car)[0].name] ?? troublesOf(car)[0].short}</text>`}
</g>`;

// Drawn again only when the console has told something new, or something else is chosen.
class Floor extends Component {
  shouldComponentUpdate(next) {
    return ["version", "chosen", "frame", "box", "width", "looks"].some((name) => next[name] !== this.props[name]);
  }
  render({ cars, view, frame, box, width, height, chosen }) {
    const [left, bottom, right, top] = box;
    const per_px = Math.max((right - left) / width, (top - bottom) / height);
    const size = Math.max(CAR_M, LEAST_CAR_PX * per_px);
    const rank = (car) => (car.name === chosen ? 2 : isBad(car) ? 1 : 0); // what matters lies on top
    const here = cars.filter((car) => view.places[car.name]?.frame === frame);
    return html`<svg viewBox=${`${left} ${-top} ${right - left} ${top - bottom}`} role="img" aria-label=${t.mapPicture(here.map((car) => car.name))}>
      ${frame === "" && view.world && html`<${Ground} world=${view.world} />`}
      ${here.map((car) => {
        const { x, y } = view.places[car.name];
        const trail = view.trails[car.name];
        return trail && html`<path class="trail" key=${car.name} d=${path([...trail.map(([, ...point]) => point), [x, y]])} style=${{ stroke: car.color }} />`;
      })}
      ${[...here].sort((one, other) => rank(one) - rank(other)).map(
        (car) => html`<${CarMark} key=${car.name} car=${car} place=${view.places[car.name]} size=${size} letter=${LETTER_PX * per_px} isChosen=${car.name === chosen} />`,
      )}
    </svg>`;
  }
}

const doing = (car) => {
  const driver = driverOf(car);
  return [driver && t.drivenMark(who(driver)), motionWords(car), modeWords(car.mode.asked)].filter(Boolean).join(" · ");
};

function Row({ car, place, frame, isChosen, onChoose }) {
  const where = place === undefined ? t.mapNone : t.mapPlace(place.x, place.y, degrees(place.yaw));
  const how = place === undefined ? "" : place.isTrue ? t.mapSimulated : t.mapMeasured(place.frame, place.std);
  const notes = place === undefined ? [] : [place.age_s !== null && t.mapOld(t.ago(place.age_s)), place.frame !== frame && t.mapElsewhere(t.mapFloors(place.frame))].filter(Boolean);
  return html`<li><button class="car map-row" style=${{ "--car": car.color }} data-place=${car.name} aria-pressed=${isChosen} onClick=${onChoose}>
    <strong>${car.name}</strong>${isBad(car) && html` <span class="bad" data-wrong>⚠ ${troublesOf(car).map((each) => each.words).join(", ")}</span>`}
    <span>${doing(car)}</span>
    <span class="dim">${where}</span>
    ${how && html`<span class="dim">${how}${notes.length > 0 && html` <strong class="bad">${notes.join(", ")}</strong>`}</span>`}
  </button></li>`;
}

// The size of the picture on the screen, so that names are as large on a phone.
function useSize() {
  const area = useRef(null);
  const [size, setSize] = useState([600, 400]);
  useEffect(() => {
    const watch = new ResizeObserver(([{ contentRect }]) => setSize([Math.max(1, contentRect.width), Math.max(1, contentRect.height)]));
    watch.observe(area.current);
    return () => watch.disconnect();
  }, []);
  return [area, ...size];
}

const boxes = new Map(); // by floor: grows while the page is open

function Scrub() {
  const { at, whole, canScrub, go } = useMoments();
  return html`<div class="time map-time"><div class="time-scale"><time>${clock(whole.from)}</time><strong data-moment=${at}>${clock(at, 10)}</strong><time>${clock(whole.to)}</time></div>
    <input type="range" name="scrub" aria-label=${t.scrub} aria-valuetext=${clock(at, 10)} min=${whole.from} max=${whole.to} step="100" value=${at}
      disabled=${!canScrub} onInput=${(event) => go(event.target.valueAsNumber)} /></div>`;
}

export function MapPage() {
  const [chosen, setChosen] = useState("");
  const [asked, setAsked] = useState(null); // the floor that somebody chose
  const [area, width, height] = useSize();
  useEffect(() => {
    boxes.clear();
    wish({ t: "map" });
    need({ map: true });
    return () => {
      unwish("map", { t: "map_end" });
      need({ map: false });
    };
  }, []);
  const cars = carsInPlace();
  const view = shownMap();
  const floors = floorsOf(view.places);
  const frame = floors.includes(asked) ? asked : (floors[0] ?? "");
  const key = `${store.past?.session ?? ""} ${frame}`;
  const box = boxOf(pointsOf(view.world, view.places, view.trails, frame), boxes.get(key) ?? null);
  boxes.set(key, box);
  const fit = () => {
    boxes.delete(key);
    setChosen("");
  };
  const isComing = store.past !== null && store.past.map === null;
  const placed = cars.filter((car) => view.places[car.name] !== undefined);
  const others = isComing ? [] : cars.filter((car) => view.places[car.name] === undefined);
  const row = (car) => html`<${Row} key=${car.name} car=${car} place=${view.places[car.name]} frame=${frame} isChosen=${chosen === car.name}
    onChoose=${() => setChosen(chosen === car.name ? "" : car.name)} />`;
  return html`<div class="map">
    <div class="controls map-head"><h1>${t.map}</h1>
      ${floors.length > 1 && html`<label>${t.mapFloor} <select name="floor" value=${frame} onChange=${(event) => setAsked(event.target.value)}>
        ${floors.map((each) => html`<option key=${each} value=${each}>${t.mapFloors(each)}</option>`)}</select></label>`}
      <button data-fit onClick=${fit}>${t.mapFit}</button>
    </div>
    <div class="map-area" ref=${area}><${Floor} cars=${cars} view=${view} version=${view.version} frame=${frame} box=${box} width=${width} height=${height} chosen=${chosen}
      looks=${cars.map((car) => [car.name, car.color, ...troublesOf(car).map((each) => each.short)]).join(" ")} /></div>
    <section class="map-list" aria-label=${t.mapCars}>
      ${isComing && html`<p role="status">${t.loading}</p>`}
      <ul class="plain">${placed.map(row)}${others.map(row)}</ul>
      ${others.length > 0 && html`<p class="hint">${t.mapNoneWhy}</p>`}
      <p class="hint">${t.mapLegend}</p>
    </section>
    <${Scrub} />
  </div>`;
}
