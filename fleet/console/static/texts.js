// All texts of the page, in English. Texts of gateways (refusals, events) are shown as they come.

export const links = {
  online: ["●", "online"],
  quiet: ["◐", "quiet, as expected in this mode"],
  stale: ["◌", "stale: the car should report, and does not"],
  lost: ["✕", "lost"],
  unknown: ["?", "unknown"],
};

export const verdicts = {
  confirmed: ["✓", "confirmed"],
  assumed: ["~", "assumed"],
  contradicted: ["≠", "contradicted"],
};

export const motors = {
  "off shown": ["■", "off, shown by its readings"],
  "off sent": ["□", "off as sent; this car cannot show it"],
  off: ["□", "off"],
  on: ["▶", "on"],
  stopping: ["…", "stopping, not shown yet"],
  unknown: ["?", "unknown"],
};

export const motions = {
  stop: "standing",
  forward: "↑ forward",
  back: "↓ back",
  left: "↰ left",
  right: "↱ right",
  spin_left: "↺ spinning left",
  spin_right: "↻ spinning right",
  unknown: "unknown",
};

export const modes = {
  manual: ["Manual", "Stops the car. Then you drive it."],
  remote_control: ["Infrared remote", "Only the infrared remote drives the car. It reports nothing."],
  tracking: ["Line tracking", "Drives off at once, along a line on the floor."],
  obstacle_avoidance: ["Obstacle avoidance", "Drives off at once and avoids obstacles. It reports nothing. A stop may take 4 s."],
  color_led: ["Color LED", "Stands and shows colors. It reports nothing."],
  light_seeking: ["Light seeking", "Drives toward light, as soon as there is some."],
  following: ["Following", "Drives after what is in front of it."],
  unknown: ["Unknown", ""],
};

export const trends = { falling: "↓ falling", steady: "→ steady", rising: "↑ rising" };

export const stopStates = {
  asked: ["…", "asked"],
  stopping: ["…", "stopping"],
  shown: ["✓", "stands, shown"],
  sent: ["□", "stop sent; this car cannot show it"],
  failed: ["✕", "not stopped"],
};

export const pad = [
  ["left", "↰", "Left", "Q"],
  ["forward", "↑", "Forward", "W"],
  ["right", "↱", "Right", "E"],
  ["spin_left", "↺", "Spin left", "A"],
  ["back", "↓", "Back", "S"],
  ["spin_right", "↻", "Spin right", "D"],
];

export const t = {
  title: "Fleet console",
  fleet: "Fleet",
  drive: "Drive",
  noCars: "No car is on the bus yet. `fleet up` connects the cars of your fleet file; `fleet up --sim 3` simulates three.",
  connecting: "Connecting to the console…",
  consoleLost: "The console does not answer. A car that you drove stops by itself. STOP is still sent; look at the cars.",
  hubLost: "The console has lost the bus. What the cards show is old, and a STOP may not arrive: look at the cars.",
  stop: "STOP all cars",
  stopKeys: "Escape, or Space",
  stopCar: "Stop",
  estop: "E-stop…",
  estopNow: "E-stop all cars now",
  estopWhy: "What happened? (for the record)",
  cancel: "Cancel",
  estopped: "E-stopped",
  endEstop: "End the e-stop…",
  endEstopSure: "Yes, end it: the cars may move again",
  resume: "Resume",
  resumeHint: "The plan may use it again.",
  held: (by) => `On hold: ${by} stopped it. No plan moves it until someone drives it or resumes it.`,
  estopLine: (by, why, scope) =>
    `E-stop of ${scope === "fleet" ? "the whole fleet" : "this car"} by ${by}${why ? `: ${why}` : ""}. Only stops are accepted.`,
  link: "Link",
  mode: "Mode",
  motors: "Motors",
  motion: "Motion",
  battery: "Battery",
  distance: "Distance",
  noEcho: "no echo",
  line: "Line",
  obstacle: "Obstacle",
  control: "In control",
  event: "Last event",
  nobody: "nobody",
  notMeasured: "not measured in this mode",
  seesLine: (names) => (names.length ? `line under ${names.join(", ")}` : "no line"),
  seesObstacle: (names) => (names.length ? `obstacle ${names.join(" and ")}` : "clear"),
  lineNames: ["outer left", "inner left", "inner right", "outer right"],
  sideNames: ["left", "right"],
  ago: (s) => (s < 90 ? `${s} s` : s < 5400 ? `${Math.round(s / 60)} min` : `${Math.round(s / 3600)} h`),
  gone: (car, ago) => `The gateway of ${car} left the bus ${ago} ago. Whether ${car} moves is not known, and nothing stops it.`,
  goneDo: "Look at the car. `fleet up` or `gateway run` starts a gateway, which stops it first.",
  lost: (car, ago, motorWords) => `Link lost for ${ago}. Last known: motors ${motorWords}. A car keeps its last motion without a link.`,
  lostDo: "Look at the car; switch it off if it drives. The gateway reconnects by itself and stops it first.",
  stale: (car, ago) => `${car} has not reported for ${ago}, but its link is open.`,
  staleDo: "Is it on, its fan off, and near enough?",
  select: "Cars to drive",
  selectHint: "Select at least one car.",
  padLabel: "Hold to drive",
  padHint: "Hold a button, an arrow key, or W A S D. Release it and the cars stop.",
  driving: (motion, cars) => `${motion}: ${cars.join(", ")}`,
  lease: "Who drives",
  leaseOf: (holder, kind) => `${holder} (${kind})`,
  take: "Take over",
  giveBack: "Give back",
  led: "Color LED",
  setLed: "Set LED",
  light: "Light",
  speed: "Speed",
  speedEstimate: (share) => `about ${Math.round(share * 100)} % of full speed (an estimate: the car knows only steps)`,
  slower: "Slower",
  faster: "Faster",
  servo: "Front servo",
  servoRange: "0° to 180°; the car turns its servo to 180° minus this",
  servoStep: { left: "Left", right: "Right", up: "Up", down: "Down", reset: "Middle" },
  servoNames: { front: "Front servo", vertical: "Vertical servo", horizontal: "Horizontal servo" },
  arm: "Arm",
  joint: (n) => `Joint ${n}, 0° to 180°`,
  moveArm: "Move the arm",
  fan: "Fan",
  toggleFan: "Toggle the fan",
  fanState: (on) => `By our count it is ${on ? "on: the car may report nothing" : "off"}. The car knows only a toggle.`,
  whistle: "Whistle",
  identify: "Identify (blink and beep)",
  sounds: "Sound",
  cannot: (car, why) => `${car}: ${why}`,
  results: "Results",
  done: (verb, outcome) => `${outcome.car}: ${verb} ${outcome.phase}${outcome.words ? `: ${outcome.words}` : ""}`,
  refused: (outcome) => `${outcome.car}: not carried out: ${outcome.words || outcome.reason || outcome.phase}`,
  stopSummary: (cars) => {
    const of = (state) => cars.filter((car) => state.includes(car.state)).length;
    const waiting = of(["asked", "stopping"]);
    const parts = [`${of(["shown"])} of ${cars.length} shown`];
    if (of(["sent"])) parts.push(`${of(["sent"])} sent`);
    if (waiting) parts.push(`${waiting} stopping`);
    if (of(["failed"])) parts.push(`${of(["failed"])} NOT stopped`);
    return parts.join(", ");
  },
  took: (s) => (s === null ? "" : `after ${s.toFixed(1)} s`),
  plan: "Plan",
  noPlan: "No plan is running. `fleet up --plan FILE` starts one.",
  coordinator: "Coordinator",
  planRuns: (version, by) => `Plan ${version}${by ? `, set by ${by}` : ""}: running.`,
  planStopped: (version, by) => `Plan ${version}: stopped by ${by}. It moves no car until you restart it.`,
  planOld: (version) => `Its coordinator has gone. Plan ${version} was in force. The cars keep their modes.`,
  phase: (name) => `Phase: ${name}`,
  rules: (names) => `Rules in force: ${names.join(", ")}`,
  roles: "Who has which role",
  noCar: "no car",
  why: "Why",
  because: (words) => `Because: ${words}`,
  reading: (words) => `Reading: ${words}`,
  wouldChange: (words) => `Would change if: ${words}`,
  planNext: "Next phase",
  planRestart: "Restart the plan",
  planStop: "Stop the plan: let go of all cars",
  otherPlan: "Another plan",
  planText: "Text of the plan",
  planFile: "Load a file",
  planCheck: "Check",
  planSet: "Put in force",
  planCurrent: "Take the plan in force",
  planGood: "No faults found.",
  fault: (line, words) => `Line ${line}: ${words}`,
  unreachable: "The console does not answer.",
  skip: "Skip to content",
};
