// Where each car stands on the pages. Pure. A car keeps its place while the page is open, whoever comes and goes: a press
// must not meet another car than the one that the eye has chosen.

// Anybody on the bus may invent cars, which leave empty places. Beyond this number, the oldest one is used again.
const MAX_EMPTY = 16;

// Return the name of each place. A car that has gone leaves its name there. New cars come behind all others, own ones first.
export function placed(before, names, isOwn) {
  const places = [...before];
  const empty = [...places.keys()].filter((place) => !names.includes(places[place]));
  const fresh = names.filter((name) => !places.includes(name));
  for (const name of [...fresh.filter(isOwn), ...fresh.filter((each) => !isOwn(each))]) {
    if (empty.length > MAX_EMPTY) places[empty.shift()] = name;
    else places.push(name);
  }
  return places;
}
