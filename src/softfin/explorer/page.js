/* The page: what is chosen, what is dragged, and the loop in real time. */

const contents = JSON.parse(element("contents").textContent), { controllers, plants, fin } = contents;
const plane = element("plane"), water = element("water"), traces = element("traces"), SETTLED_N = 0.1, PUSH_M_S = [0, 0.6];
const range = planeRange(controllers), makers = { tank: Tank, surrogate: StreamingSurrogate }, surrogateName = plants.findIndex((each) => each.kind === "surrogate");

/* What is chosen; the address holds it behind the #. */
const chosen = { controller: 0, plant: 0, x: 2, y: 0, speed: "1", fin: "1", cold: false, trim: true, paused: matchMedia("(prefers-reduced-motion: reduce)").matches };

let loop = null, last = null, asked = { time: 0, within: null }, pushed = -Infinity, told = -Infinity, dragging = false;

function begin() {
  const made = Object.fromEntries(plants.map((each, index) => [index, new makers[each.kind](each)]));
  loop = new Loop(made, String(chosen.plant), new Controller(controllers[chosen.controller]), [chosen.x, chosen.y]);
  asked = { time: 0, within: null };
  pushed = -Infinity;
  apply();
}

/* Have the loop do what is chosen, the controls show it, and the address hold it. */
function apply() {
  if (controllers[chosen.controller] !== loop.controller.description) loop.change(new Controller(controllers[chosen.controller]));
  if (chosen.trim !== (loop.controller.observer !== null)) loop.controller.trim(chosen.trim, loop.action);
  loop.plant = String(chosen.plant);
  for (const plant of Object.values(loop.plants)) {
    if (plant instanceof Tank) [plant.stiffness, plant.cold] = [Number(chosen.fin), chosen.cold];
  }
  ask(chosen.x, chosen.y);
  for (const name of ["controller", "plant", "speed", "fin"]) element(name).value = String(chosen[name]);
  for (const name of ["cold", "trim"]) element(name).setAttribute("aria-pressed", String(chosen[name]));
  element("pause").textContent = chosen.paused ? "Play" : "Pause";
  const inTank = plants[chosen.plant].kind === "tank";
  for (const name of ["cold", "push", "fin"]) element(name).disabled = !inTank;
  element("tank-only").hidden = inTank;
  const flags = Object.fromEntries(["cold", "trim", "paused"].map((name) => [name, Number(chosen[name])]));
  const state = new URLSearchParams({ controller: controllers[chosen.controller].name, plant: plants[chosen.plant].name, reference: `${chosen.x.toFixed(2)},${chosen.y.toFixed(2)}`, speed: chosen.speed, fin: chosen.fin, ...flags });
  element("link").href = `#${state}`;
  // Not while one drags: browsers refuse to write the address a hundred times in ten seconds.
  if (!dragging) history.replaceState(null, "", `#${state}`);
  redraw();
}

/* Choose what the address holds; anything that it does not, or that there is not, stays. */
function readAddress() {
  const state = new URLSearchParams(location.hash.slice(1)), named = (list, name) => list.findIndex((each) => each.name === state.get(name));
  if (named(controllers, "controller") >= 0) chosen.controller = named(controllers, "controller");
  if (named(plants, "plant") >= 0) chosen.plant = named(plants, "plant");
  const [x, y] = (state.get("reference") || "").split(",").map(Number);
  if (Number.isFinite(x) && Number.isFinite(y)) [chosen.x, chosen.y] = [x, y];
  for (const name of ["speed", "fin"]) if ([...element(name).options].some((option) => option.value === state.get(name))) chosen[name] = state.get(name);
  for (const name of ["cold", "trim", "paused"]) if (state.has(name)) chosen[name] = state.get(name) === "1";
}

/* Ask for a force, or for the nearest that this controller can hold. */
function ask(x, y) {
  const { cells, reachable } = loop.controller, near = nearestReference(cells, reachable, [x, y]) || loop.reference;
  [chosen.x, chosen.y] = near.map((value) => Math.round(value * 100) / 100);
  const inside = nearestReference(cells, reachable, [chosen.x, chosen.y]) || near;
  if (distanceTo(inside, loop.reference) > 1e-9) asked = { time: loop.time, within: null };
  loop.reference = inside;
  for (const [name, value] of [["x", chosen.x], ["y", chosen.y]]) if (document.activeElement !== element(name)) element(name).value = value.toFixed(2);
}

function choose(changes) {
  Object.assign(chosen, changes);
  apply();
}

/* Run the loop for so many ticks of 10 ms. */
function run(ticks) {
  for (let k = 0; k < ticks; k++) {
    loop.tick();
    if (Math.max(...loop.error()) > SETTLED_N) asked.within = null;
    else if (asked.within === null) asked.within = loop.time;
  }
}

const seconds = (ticks) => (ticks * TICK_S).toFixed(1);

/* The surrogate's mean force, its interval, and the distance of its motion from its training data; null without one. */
function prediction() {
  if (surrogateName < 0 || loop.time === 0) return null;
  const plant = loop.plants[surrogateName], means = loop.memberAverages[surrogateName].map((window) => window.mean());
  return { mean: loop.averages[surrogateName].mean(), half: [0, 1].map((axis) => plant.halfWidth(means.map((mean) => mean[axis]))), distance: plant.distance() };
}

function tell(predicted) {
  const show = (name, values, digits = 2) => values.forEach((value, axis) => { element(`${name}-${"xy"[axis]}`).textContent = value === null ? "\u2013" : numeral(value, digits); });
  const { controller } = loop;
  show("mean", loop.averages[loop.plant].mean());
  show("error", loop.error(), 3);
  show("sobolev", loop.averages[loop.plant].sobolev());
  if (surrogateName >= 0) {
    show("predicted", predicted ? predicted.mean : [null, null]);
    show("half", predicted ? predicted.half : [null, null]);
    element("distance").textContent = predicted ? `${predicted.distance.toFixed(2)}${predicted.distance > 1 ? ": beyond its data" : ""}` : "\u2013";
  }
  element("time").textContent = `${seconds(loop.time)} s`;
  element("cell").textContent = controller.cells.length > 1 ? `policy ${controller.step.activeCell + 1} of ${controller.cells.length} acts` : "";
  element("bias").textContent = controller.observer ? `taken off: (${controller.observer.bias.map((value) => numeral(value, 2)).join(", ")}) N` : "";
  const held = asked.within !== null && loop.time - asked.within >= 50, force = `(${numeral(chosen.x, 2)}, ${numeral(chosen.y, 2)}) N`;
  const status = held ? `${force} held within ${SETTLED_N} N, ${seconds(Math.max(asked.within - asked.time, 0))} s after it was asked for.` : `Asked for ${force}; not held yet.`;
  // Screen readers speak what is written anew.
  if (element("status").textContent !== status) element("status").textContent = status;
}

function draw() {
  const predicted = prediction(), tank = plants[chosen.plant].kind === "tank";
  drawPlane(plane, range, loop, predicted);
  const note = (loop.time - pushed) * TICK_S < 1.5 ? "The water was pushed towards +y." : tank ? "" : "Shape not known: drawn straight at the shaft's angle.";
  drawWater(water, loop, fin, note);
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
  if (!chosen.paused) {
    owed += last === null ? 0 : Math.min((now - last) / 1000, 0.1) * Number(chosen.speed) / TICK_S;
    run(Math.floor(owed));
    owed -= Math.floor(owed);
    draw();
  }
  last = now;
  requestAnimationFrame(advance);
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
  if (event.button !== 0) return;
  plane.setPointerCapture(event.pointerId);
  dragging = true;
  drag(event);
});
plane.addEventListener("pointermove", (event) => { if (dragging) drag(event); });
plane.addEventListener("lostpointercapture", () => { dragging = false; apply(); });

const next = (list, value) => list[(list.indexOf(value) + 1) % list.length];
const push = () => {
  Object.values(loop.plants).filter((plant) => plant instanceof Tank).forEach((plant) => plant.push(PUSH_M_S));
  pushed = loop.time;
  redraw();
};
const ACTIONS = {
  " ": () => choose({ paused: !chosen.paused }),
  t: () => choose({ trim: !chosen.trim }),
  p: () => { if (!element("push").disabled) push(); },
  w: () => { if (!element("cold").disabled) choose({ cold: !chosen.cold }); },
  f: () => { if (!element("fin").disabled) choose({ fin: next([...element("fin").options].map((option) => option.value), chosen.fin) }); },
  c: () => choose({ controller: (chosen.controller + 1) % controllers.length }),
  s: () => choose({ speed: next([...element("speed").options].map((option) => option.value), chosen.speed) }),
  r: begin,
};
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select")) return;
  const step = event.shiftKey ? 0.5 : 0.1, arrow = ARROWS[event.key], action = ACTIONS[event.key.toLowerCase()];
  if (arrow) choose({ x: chosen.x + step * arrow[0], y: chosen.y + step * arrow[1] });
  else if (action && !(event.key === " " && event.target.matches("button, summary, a"))) action();
  else return;
  event.preventDefault();
});
for (const name of ["controller", "plant"]) element(name).addEventListener("change", () => choose({ [name]: Number(element(name).value) }));
for (const name of ["speed", "fin"]) element(name).addEventListener("change", () => choose({ [name]: element(name).value }));
for (const [name, key] of [["pause", " "], ["trim", "t"], ["cold", "w"], ["push", "p"], ["restart", "r"]]) element(name).addEventListener("click", ACTIONS[key]);
for (const name of ["x", "y"]) {
  element(name).addEventListener("change", () => { if (element(name).value !== "") choose({ [name]: Number(element(name).value) }); });
  element(name).addEventListener("blur", () => ask(chosen.x, chosen.y));
}
addEventListener("hashchange", () => { readAddress(); apply(); });

followColours(["page", "text", "soft", "rule", "beyond", "reach", "lit", "fin", "measured", "asked", "mean", "predicted"]);
readAddress();
begin();
new ResizeObserver(redraw).observe(document.querySelector("main"));
requestAnimationFrame(advance);
