// Line drawings of 24 by 24: letters that look like symbols differ from phone to phone.

const PATHS = {
  fleet: "M4 4h6v6H4zM14 4h6v6h-6zM4 14h6v6H4zM14 14h6v6h-6z",
  drive: "M12 3v18M3 12h18M9 6l3-3 3 3M9 18l3 3 3-3M6 9l-3 3 3 3M18 9l3 3-3 3",
  plan: "M9 6h11M9 12h11M9 18h11M4 6h1M4 12h1M4 18h1",
  plots: "M4 4v16h16M7 15l4-5 3 3 5-7",
  time: "M3 12h18M7 8v8M12 9.500v5M17 8v8",
  inspect: "M11 4a7 7 0 1 0 0 14 7 7 0 0 0 0-14zM16 16l5 5",
  people: "M12 4a4 4 0 1 0 0 8 4 4 0 0 0 0-8zM4 21c0-4 3-6 8-6s8 2 8 6",
  sessions: "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18zM12 10a2 2 0 1 0 0 4 2 2 0 0 0 0-4z",
  setup: "M4 7h9M17 7h3M4 17h3M11 17h9M15 5a2 2 0 1 0 0 4 2 2 0 0 0 0-4zM9 15a2 2 0 1 0 0 4 2 2 0 0 0 0-4z",
  more: "M5 11v2M12 11v2M19 11v2",
  stop: "M8 3h8l5 5v8l-5 5H8l-5-5V8z",
  pause: "M8 5v14M16 5v14",
  estop: "M12 3l9.500 17h-19zM12 10v4M12 17v.500",
};

export const icon = (html, name) => html`<svg class="icon" viewBox="0 0 24 24" aria-hidden="true"><path d=${PATHS[name]} /></svg>`;
