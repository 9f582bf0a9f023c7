/* The page: what is chosen, what is dragged, and the loop in real time. */

const contents = JSON.parse(element("contents").textContent), { controllers, plants } = contents;
useClock(controllers[0].clock);
const plane = element("plane"), water = element("water"), traces = element("traces"), PUSH_M_S = [0, 0.6];
/* The fin's size relative to the paper's, whose reach is 2.4 N, and whose force by hand peaks at 10 N; the steps of its forces [N], 0.01 and 0.1 N for that; decimals of forces. */
const PAPER_PEAK_N = 10;
const hand = controllers.at(-1), makers = { tank: Tank, surrogate: StreamingSurrogate };
const finSize = controllers[0].size ?? (peakForce(new makers[plants[0].kind](plants[0]), hand) / PAPER_PEAK_N || 1), HUNDREDTH_N = 0.01 * finSize, SETTLED_N = 0.1 * finSize, decimals = Math.max(0, 2 - Math.floor(Math.log10(2.4 * finSize)));
const range = planeRange(controllers);
/* Shortest time between two writes of the address: Safari takes a hundred in thirty seconds. */
const WRITE_MS = 400;

/* Stiffness and drag of the fin in a tank [%], which change while it beats. */
const NEW_FIN = { stiffness: 100, drag: 100 }, FIN_RANGE = [50, 150];

/* What is chosen; the address holds it behind the #. (x, y) is the force that is wished for; the loop's reference is the
 * nearest that the controller can hold. */
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const chosen = { controller: 0, plant: 0, x: 2 * finSize, y: 0, speed: "1", feedback: "both", paused: still, ...NEW_FIN, ...hand.first };
const choicesOf = (name) => [...element(name).options].map((option) => option.value);
const byHand = () => controllers[chosen.controller] === hand;
/* Limits of the sliders for motion by hand, which move in hundredths; the angle limits are rounded, so that 0 is allowed. */
const HAND_SLIDERS = {
  angle: [Math.ceil(100 * hand.limits.angle_min_rad) / 100, Math.floor(100 * hand.limits.angle_max_rad) / 100],
  stroke: [0, (hand.limits.angle_max_rad - hand.limits.angle_min_rad) / 2],
  velocity: [hand.limits.velocity_min_rad_s, hand.limits.velocity_max_rad_s],
};
const SLIDERS = { ...HAND_SLIDERS, stiffness: FIN_RANGE, drag: FIN_RANGE };
const digitsOf = (name) => (name in NEW_FIN ? 0 : 2);

let loop = null, last = null, applied = "", missing = [], pushed = -Infinity, told = -Infinity, finger = null, writing = false, barEnd = 0;

/* How the force does since the target or a condition changed: when the error came within the limit, and its sum. */
let watched = null;
function watch(what) {
  watched = { what, since: loop.time, within: null, sum: [0, 0], count: 0 };
}

/* Feedback from torque requires a family of fins. */
const feedbackUses = () => (chosen.feedback === "torque" && controllers[chosen.controller].feedback.family === null ? "none" : chosen.feedback);

const newController = () => (byHand() ? new Hand(hand) : new Controller(controllers[chosen.controller]));

function begin() {
  const made = Object.fromEntries(plants.map((each, index) => [index, new makers[each.kind](each)]));
  loop = new Loop(made, String(chosen.plant), newController(), [chosen.x, chosen.y]);
  pushed = -Infinity;
  barEnd = 0;
  applied = "";
  apply();
}

/* Have the loop do what is chosen, the controls show it, and the address hold it. */
function apply() {
  if (controllers[chosen.controller] !== loop.controller.description) loop.change(newController());
  if (byHand()) for (const name of Object.keys(HAND_SLIDERS)) loop.controller[name] = chosen[name];
  else if (feedbackUses() !== (loop.controller.feedback?.uses ?? "none")) loop.controller.useFeedback(feedbackUses(), loop.action);
  loop.plant = String(chosen.plant);
  for (const plant of Object.values(loop.plants)) {
    if (plant instanceof Tank) [plant.stiffness, plant.drag] = [chosen.stiffness / 100, chosen.drag / 100];
  }
  const conditions = [chosen.controller, chosen.plant, chosen.feedback, chosen.stiffness, chosen.drag].join();
  if (conditions !== applied) watch(applied ? "the change" : "the target was set");
  applied = conditions;
  if (!byHand()) ask();
  document.body.classList.toggle("by-hand", byHand());
  for (const name of Object.keys(SLIDERS)) {
    element(name).value = String(chosen[name]);
    element(`${name}-value`).textContent = numeral(chosen[name], digitsOf(name));
  }
  for (const name of ["controller", "plant", "speed", "feedback"]) element(name).value = String(chosen[name]);
  element("pause").textContent = chosen.paused ? "Play" : "Pause";
  const inTank = plants[chosen.plant].kind === "tank";
  for (const name of ["push", ...Object.keys(NEW_FIN)]) element(name).disabled = !inTank;
  element("tank-only").hidden = inTank;
  const sliders = Object.fromEntries(Object.keys(SLIDERS).map((name) => [name, chosen[name].toFixed(digitsOf(name))]));
  const state = new URLSearchParams({ controller: controllers[chosen.controller].name, plant: plants[chosen.plant].name, reference: `${chosen.x.toFixed(decimals)},${chosen.y.toFixed(decimals)}`, speed: chosen.speed, feedback: chosen.feedback, ...sliders, paused: Number(chosen.paused) });
  element("link").href = `#${state}`;
  element("link").textContent = "Copy link";
  writeAddress();
  redraw();
}

/* Write the link to the address, soon; a page in a sandboxed frame may not. */
function writeAddress() {
  if (writing) return;
  writing = true;
  setTimeout(() => {
    writing = false;
    try {
      history.replaceState(null, "", element("link").href);
    } catch { /* The link can be copied all the same. */ }
  }, WRITE_MS);
}

async function copyLink(event) {
  event.preventDefault();
  let copied = "Copied";
  try {
    await navigator.clipboard.writeText(element("link").href);
  } catch {
    copied = "Copy the address";
  }
  element("link").textContent = copied;
}

/* Choose what an address holds; anything that it does not, or that there is not, stays. */
function readAddress(address) {
  const state = new URLSearchParams(new URL(address).hash.slice(1));
  missing = [];
  for (const [name, list] of [["controller", controllers], ["plant", plants]]) {
    const index = list.findIndex((each) => each.name === state.get(name));
    if (index >= 0) chosen[name] = index;
    else if (state.has(name)) missing.push(`${name} ${state.get(name)}`);
  }
  const [x, y] = (state.get("reference") || "").split(",").map(Number);
  if (Number.isFinite(x) && Number.isFinite(y)) [chosen.x, chosen.y] = [x, y];
  for (const [name, [low, high]] of Object.entries(SLIDERS)) {
    const value = parseFloat(parseFloat(state.get(name)).toFixed(digitsOf(name)));
    if (Number.isFinite(value)) chosen[name] = clip(value, low, high);
  }
  for (const name of ["speed", "feedback"]) if (choicesOf(name).includes(state.get(name))) chosen[name] = state.get(name);
  if (["0", "1"].includes(state.get("paused"))) chosen.paused = state.get("paused") === "1";
  chosen.paused ||= still;
}

/* Ask for the force that is wished for, or for the nearest that this controller can hold. */
function ask() {
  [chosen.x, chosen.y] = [chosen.x, chosen.y].map(hundredths);
  const { cells, reachable } = loop.controller, reference = nearestReference(cells, reachable, [chosen.x, chosen.y]) || loop.reference;
  if (distanceTo(reference, loop.reference) > 1e-9) watch("the target was set");
  loop.reference = reference;
  ["x", "y"].forEach((name, axis) => { element(name).value = reference[axis].toFixed(decimals); });
}

function choose(changes) {
  Object.assign(chosen, changes);
  missing = [];
  apply();
}

/* Run the loop for so many ticks of 10 ms. */
function run(ticks) {
  for (let k = 0; k < ticks; k++) {
    loop.tick();
    const error = loop.error();
    if (!(Math.max(...error) <= SETTLED_N)) watched.within = null;
    else if (watched.within === null) watched.within = loop.time;
    if (loop.time - watched.since < WINDOW) continue;
    watched.sum = watched.sum.map((sum, axis) => sum + error[axis]);
    watched.count++;
  }
}

const hundredths = (value) => Number((Math.round(value / HUNDREDTH_N) * HUNDREDTH_N).toFixed(decimals)), seconds = (ticks) => (ticks * TICK_S).toFixed(1);
const forceText = ([x, y]) => `(${numeral(x, decimals)}, ${numeral(y, decimals)}) N`;

/* The surrogate that predicts: the plant that is chosen, or else the first surrogate; -1 without one. */
const predictor = () => (plants[chosen.plant].kind === "surrogate" ? chosen.plant : plants.findIndex((each) => each.kind === "surrogate"));

/* Its mean force over INTERVAL_WINDOW and the interval of this mean, and the part of the
 * last window in which its motion resembled its training data; null without one, or before a whole window. */
function prediction() {
  const index = predictor();
  if (index < 0 || loop.time < Math.max(WINDOW, INTERVAL_WINDOW)) return null;
  const plant = loop.plants[index], means = loop.memberAverages[index].map((window) => window.mean()), distances = loop.distances[index];
  const half = [0, 1].map((axis) => plant.halfWidth(means.map((mean) => mean[axis])));
  const mean = [0, 1].map((axis) => means.reduce((sum, each) => sum + each[axis], 0) / means.length);
  return { mean, half, familiar: distances.filter((distance) => distance <= 1).length / distances.length };
}

/* The correction by feedback, or the reason why there is none. */
function feedbackText() {
  const { feedback, added, description } = loop.controller;
  if (byHand() || chosen.feedback === "none" || added === null) return "";
  if (chosen.feedback === "torque" && description.feedback.family === null) return "Feedback from torque requires a family of fins (softfin family).";
  if (chosen.feedback === "torque" && loop.plants[loop.plant].power === "") return "This surrogate does not predict the torque.";
  const adds = `Feedback adds ${forceText(added)}`;
  if (description.feedback.family === null) return `${adds}.`;
  return `${adds}; ${feedback.level > UNFAMILIAR ? "the fin is outside the family, so feedback relies on the mean force" : "the fin is within the family"}.`;
}

function tell(predicted) {
  const show = (name, values, digits = decimals) => values.forEach((value, axis) => { element(`${name}-${"xy"[axis]}`).textContent = Number.isFinite(value) ? numeral(value, digits) : "\u2013"; });
  const { controller } = loop, average = loop.averages[loop.plant], none = [NaN, NaN];
  show("mean", loop.mean());
  show("error", loop.error(), decimals + 1);
  show("average", watched.count ? watched.sum.map((sum) => sum / watched.count) : none, decimals + 1);
  show("sobolev", loop.time < WINDOW ? none : average.sobolev());
  if (predictor() >= 0) {
    element("predictor").textContent = `mean over ${Number(seconds(INTERVAL_WINDOW))} s in ${plants[predictor()].name}`;
    element("coverage").textContent = `its ${Math.round(100 * plants[predictor()].interval.coverage)}% interval, \u00b1`;
    show("predicted", predicted ? predicted.mean : none);
    show("half", predicted ? predicted.half : none);
    element("distance").textContent = predicted ? `${Math.floor(100 * predicted.familiar)}% of the time` : "\u2013";
  }
  tellPower();
  element("time").textContent = `${seconds(loop.time)} s`;
  element("cell").textContent = controller.cells.length > 1 && controller.tracked !== null ? `policy ${controller.step.activeCell + 1} of ${controller.cells.length} acts` : "";
  const estimate = controller.feedback && controller.added ? controller.feedback.estimate() : { mean: none, half: none };
  show("estimate", estimate.mean);
  show("within", estimate.half);
  element("feedback-state").textContent = feedbackText();
  element("missing").textContent = missing.length ? `Not in this page: ${missing.join(", ")}.` : "";
  const held = watched.within !== null && loop.time - watched.within >= 50, wish = [chosen.x, chosen.y], force = forceText(loop.reference);
  const near = distanceTo(wish, loop.reference) > HUNDREDTH_N ? `${forceText(wish)} is out of reach; the ring is at the nearest force in reach. ` : "";
  const yet = chosen.paused && loop.time === 0 ? "press Play" : "not held yet";
  const moved = `Moved by hand: ${numeral(chosen.angle, 2)} \u00b1 ${chosen.stroke.toFixed(2)} rad at ${chosen.velocity.toFixed(2)} rad/s.`;
  const status = byHand() ? moved : near + (held ? `${force} held within ${short(SETTLED_N)} N, ${seconds(watched.within - watched.since)} s after ${watched.what}.` : `Target ${force}: ${yet}.`);
  // Screen readers speak what is written anew.
  if (element("status").textContent !== status) element("status").textContent = status;
}

/* The mean power, its force per watt, and a bar whose end only grows, so that strokes can be compared. */
function tellPower() {
  const kind = loop.plants[loop.plant].power, power = loop.power(), known = Number.isFinite(power);
  element("power-row").hidden = kind === "";
  if (known) barEnd = Math.max(barEnd, stepOf(0, Math.max(power, 0.01 * finSize), 1));
  element("power-kind").textContent = kind;
  element("power-end").textContent = barEnd ? `${short(barEnd)} W` : "";
  element("power").textContent = known ? `${numeral(power, decimals)} W, ${forcePerWatt(Math.hypot(...loop.mean()), power)}` : "\u2013";
  element("power-bar").style.setProperty("--part", `${known ? clip((100 * power) / barEnd, 0, 100) : 0}%`);
}

function draw() {
  const predicted = prediction(), tank = plants[chosen.plant].kind === "tank";
  drawPlane(plane, range, loop, predicted);
  const note = (loop.time - pushed) * TICK_S < 1.5 ? "The water was pushed towards +y." : tank ? "" : "Shape not known: drawn straight at the shaft's angle.";
  drawWater(water, loop, plants[chosen.plant].outline, note);
  drawTraces(traces, loop);
  const now = performance.now();
  if (now - told > 100 || chosen.paused) {
    told = now;
    tell(predicted);
  }
}

/* Move in real time; where the browser leaves out frames, for as long as a tenth of a second at once. */
let owed = 0;
function advance(now) {
  requestAnimationFrame(advance);
  if (!chosen.paused) {
    owed += last === null ? 0 : Math.min((now - last) / 1000, 0.1) * Number(chosen.speed) / TICK_S;
    run(Math.floor(owed));
    owed -= Math.floor(owed);
    draw();
  }
  last = now;
}

function forceUnder(event) {
  const box = plane.getBoundingClientRect();
  return planeScale(range, box.width, box.height).force(event.clientX - box.left, event.clientY - box.top);
}

function drag(event) {
  const [x, y] = forceUnder(event);
  choose({ x, y });
}

plane.addEventListener("pointerdown", (event) => {
  if (event.button !== 0 || finger !== null || byHand()) return;
  plane.setPointerCapture(event.pointerId);
  finger = event.pointerId;
  drag(event);
});
plane.addEventListener("pointermove", (event) => { if (event.pointerId === finger) drag(event); });
plane.addEventListener("lostpointercapture", (event) => { if (event.pointerId === finger) finger = null; });

const next = (list, value) => list[(list.indexOf(value) + 1) % list.length];
const push = () => {
  Object.values(loop.plants).filter((plant) => plant instanceof Tank).forEach((plant) => plant.push(PUSH_M_S));
  pushed = loop.time;
  watch("the push");
  redraw();
};
const ACTIONS = {
  " ": () => choose({ paused: !chosen.paused }),
  t: () => choose({ feedback: next(choicesOf("feedback"), chosen.feedback) }),
  p: () => { if (!element("push").disabled) push(); },
  c: () => choose({ controller: (chosen.controller + 1) % controllers.length }),
  s: () => choose({ speed: next(choicesOf("speed"), chosen.speed) }),
  r: () => {
    Object.assign(chosen, NEW_FIN);
    begin();
  },
};
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input[type=number], select")) return;
  // The arrow keys move a slider that has the focus.
  const arrow = byHand() || event.target.matches("input") ? undefined : ARROWS[event.key], step = (event.shiftKey ? 50 : 10) * HUNDREDTH_N, action = ACTIONS[event.key.toLowerCase()];
  if (!arrow && (!action || (event.key === " " && event.target.matches("button, summary, a")))) return;
  event.preventDefault();
  if (arrow) choose({ x: loop.reference[0] + step * arrow[0], y: loop.reference[1] + step * arrow[1] });
  // Held down, a key acts once.
  else if (!event.repeat) action();
});
for (const name of ["controller", "plant"]) element(name).addEventListener("change", () => choose({ [name]: Number(element(name).value) }));
for (const name of ["speed", "feedback"]) element(name).addEventListener("change", () => choose({ [name]: element(name).value }));
for (const [name, key] of [["pause", " "], ["push", "p"], ["restart", "r"]]) element(name).addEventListener("click", ACTIONS[key]);
for (const [name, steps] of [["step", 10], ["leap", 50]]) element(name).textContent = `${short(steps * HUNDREDTH_N)} N`;
for (const name of ["x", "y"]) {
  element(name).step = short(10 * HUNDREDTH_N);
  element(name).addEventListener("change", () => { if (element(name).value !== "") choose({ [name]: Number(element(name).value) }); });
  element(name).addEventListener("blur", ask);
}
for (const [name, [low, high]] of Object.entries(SLIDERS)) {
  Object.assign(element(name), { min: low, max: high });
  element(name).addEventListener("input", () => choose({ [name]: Number(element(name).value) }));
}
element("link").addEventListener("click", copyLink);
addEventListener("hashchange", (event) => { readAddress(event.newURL); apply(); });

followColours(["page", "text", "soft", "rule", "beyond", "reach", "lit", "fin", "measured", "asked", "mean", "predicted", "water"]);
readAddress(location.href);
begin();
new ResizeObserver(redraw).observe(document.querySelector("main"));
requestAnimationFrame(advance);
