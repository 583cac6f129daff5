// What pages say of a car in a word or two: what is wrong, whether it moves, who has it. One source for all of them.

import { unheard_s, who } from "./console.js";
import { arrows, modes, t, tileMotors } from "./texts.js";

export const motorName = (car) => {
  const { state, basis } = car.motors;
  return state === "off" && basis ? `off ${basis}` : state;
};

export const isMoving = (car) => car.motors.state === "on";

// The car's gateway has gone, or has no link to the car: nothing is known of the car now, and nothing stops it.
export const isLost = (car) => !car.gateway || car.link.state === "lost";

// Somebody has stopped the car, and nothing shows yet that it stands.
export const isUnconfirmed = (car) => !isLost(car) && (car.hold !== null || car.estops.length > 0) && !["off", "stopping"].includes(car.motors.state);

// The link is open, but no reading comes over it.
export const isUnheard = (car) => car.link.state === "stale" || car.link.state === "unreadable";

// How long nothing new has come of a car, s. 0 while news come.
export const silence = (car) => (car.silent_s ?? 0) + unheard_s();

// What is wrong with a car, the worst first: each with its class, and words with and without its time. A page asks for
// it several times while it is drawn.
const found = new WeakMap(); // by car, as one message has it: [how long the console has been silent, its troubles]
export function troublesOf(car) {
  const [unheard, known] = found.get(car) ?? [];
  if (unheard === unheard_s()) return known;
  const troubles = findTroubles(car);
  found.set(car, [unheard_s(), troubles]);
  return troubles;
}

function findTroubles(car) {
  const silent_s = silence(car);
  const lost_s = car.gateway ? car.link.since_s : car.gone_s;
  return [
    isUnconfirmed(car) && ["bad", "unconfirmed"],
    isLost(car) && ["bad", "lost", lost_s],
    car.estops.length > 0 && ["bad", "estopped"],
    silent_s > 0 && !isLost(car) && ["warn", "old", silent_s],
    car.gateway && isUnheard(car) && !isUnconfirmed(car) && ["warn", car.link.state, car.link.since_s],
    car.battery?.level === "critical" && ["bad", "battery"],
  ]
    .filter(Boolean)
    .map(([level, name, since_s]) => ({ level, name, short: t.troubles[name], words: since_s ? t.troubleFor(t.troubles[name], t.ago(since_s)) : t.troubles[name] }));
}

// The motion of a car: the direction for an arrow, and words for people who cannot see the arrow.
export const directionOf = (car) => (isMoving(car) ? (car.motion.motion in arrows ? car.motion.motion : "some") : "none");
export const motionWords = (car) =>
  isMoving(car) ? (arrows[car.motion.motion]?.[1] ?? t.isMoving) : (tileMotors[motorName(car)] ?? tileMotors.unknown)[1];

export const modeWords = (word) => modes[word]?.[0] ?? word;

// The person who drives a car now, or has taken it. Empty if nobody has.
export const driverOf = (car) => (isMoving(car) && car.motion.owner) || car.lease?.holder || "";

// The person who has a car, and how. Of a lost or unconfirmed car, the words about its motion instead.
export function holderOf(car) {
  const driver = driverOf(car);
  if (isLost(car) || isUnconfirmed(car)) return motionWords(car);
  if (isMoving(car) && car.motion.owner) return t.drivenMark(who(driver));
  if (car.loan) return t.lentMark(car.loan.to);
  if (car.lease) return t.boardHolds(who(driver));
  if (car.hold !== null) return t.boardHeld(who(car.hold));
  if (car.mode.asked === "unknown") return t.notKnown;
  return car.mode.asked === "manual" ? t.boardFree : t.boardItself;
}
