import * as THREE from "three";

/* canvas.js */

const trial = JSON.parse(element("trial").textContent);
const { frames, fins, points } = trial;
const canvas = element("scene"), slider = element("time"), play = element("play");
const NEWTON_M = 0.08;

let now = 0, playing = false, last = null;

/* The robot's world axes are x ahead, y left, z up, but y is up in three.js, so the scene is in a rotated group. */
const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
const scene = new THREE.Scene(), world = new THREE.Group();
world.rotation.x = -Math.PI / 2;
scene.add(world);
scene.add(new THREE.HemisphereLight(0xffffff, 0x607080, 2.2));
const sun = new THREE.DirectionalLight(0xffffff, 1.6);
sun.position.set(1, 3, 2);
scene.add(sun);
const camera = new THREE.PerspectiveCamera(40, 1, 0.01, 100);
const view = { turn: 0.75, tilt: 0.5, far: 1.9, at: new THREE.Vector3() };

const paint = (name, options = {}) => ({ name, material: new THREE.MeshStandardMaterial({ roughness: 0.7, ...options }) });
const paints = [paint("body"), paint("fin", { side: THREE.DoubleSide }), paint("asked"), paint("measured")];
const strokes = ["path", "grid"].map((name) => ({ name, material: new THREE.LineBasicMaterial({ transparent: true, opacity: 0.8 }) }));
const materialOf = (name) => [...paints, ...strokes].find((each) => each.name === name).material;

const vector = (series, frame) => new THREE.Vector3(...series.slice(3 * frame, 3 * frame + 3));
const quaternion = (frame) => {
  const [w, x, y, z] = trial.attitude.slice(4 * frame, 4 * frame + 4);
  return new THREE.Quaternion(x, y, z, w);
};

/* The hull: a flat ellipsoid like a turtle's shell, with a fin-sized bump at its nose. */
const robot = new THREE.Group();
world.add(robot);
const hull = new THREE.Mesh(new THREE.SphereGeometry(0.5, 40, 24), materialOf("body"));
hull.scale.set(...trial.size);
robot.add(hull);
const nose = new THREE.Mesh(new THREE.ConeGeometry(0.025, 0.06, 20), materialOf("fin"));
nose.rotation.z = -Math.PI / 2;
nose.position.x = trial.size[0] / 2 + 0.02;
robot.add(nose);

const thickness = 0.008;
const blades = fins.map((fin) => {
  const hub = new THREE.Mesh(new THREE.CylinderGeometry(0.014, 0.014, trial.span * 1.1, 16), materialOf("fin"));
  const shaft = new THREE.Vector3(...fin.shaft);
  hub.position.set(...fin.place);
  hub.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), shaft);
  robot.add(hub);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * 4 * Math.max(points, 2)), 3));
  const index = [];
  for (let i = 0; i + 1 < points; i++) {
    const a = 4 * i, b = 4 * (i + 1);
    for (const [p, q] of [[0, 1], [1, 3], [3, 2], [2, 0]]) index.push(a + p, b + p, a + q, a + q, b + p, b + q);
  }
  const end = 4 * (points - 1);
  index.push(end, end + 1, end + 2, end + 1, end + 3, end + 2);
  geometry.setIndex(index);
  const mesh = new THREE.Mesh(geometry, materialOf("fin"));
  robot.add(mesh);
  const place = new THREE.Vector3(...fin.place);
  const x = new THREE.Vector3(fin.axes[0], fin.axes[2], fin.axes[4]), y = new THREE.Vector3(fin.axes[1], fin.axes[3], fin.axes[5]);
  return { geometry, shaft, place, x, y };
});

function bend(frame) {
  blades.forEach((blade, f) => {
    const at = (i) => {
      const k = 2 * ((frame * fins.length + f) * points + i);
      return blade.place.clone()
        .addScaledVector(blade.x, trial.shapes[k] * trial.shape_unit)
        .addScaledVector(blade.y, trial.shapes[k + 1] * trial.shape_unit);
    };
    const corners = blade.geometry.attributes.position;
    for (let i = 0; i < points; i++) {
      const middle = at(i), way = at(Math.min(i + 1, points - 1)).sub(at(Math.max(i - 1, 0))).normalize();
      const across = way.cross(blade.shaft).normalize();
      const thick = thickness * (1 - (0.6 * i) / (points - 1));
      [[-1, -1], [-1, 1], [1, -1], [1, 1]].forEach(([side, face], c) => {
        const corner = middle.clone().addScaledVector(blade.shaft, (side * trial.span) / 2).addScaledVector(across, face * thick);
        corners.setXYZ(4 * i + c, corner.x, corner.y, corner.z);
      });
    }
    corners.needsUpdate = true;
    blade.geometry.computeVertexNormals();
  });
}

const arrowOf = (name) => {
  const group = new THREE.Group();
  const rod = new THREE.Mesh(new THREE.CylinderGeometry(0.006, 0.006, 1, 12), materialOf(name));
  const head = new THREE.Mesh(new THREE.ConeGeometry(0.018, 0.05, 16), materialOf(name));
  group.add(rod, head);
  world.add(group);
  return (from, newtons) => {
    const length = newtons.length() * NEWTON_M;
    group.visible = length > 0.01;
    if (!group.visible) return;
    group.position.copy(from);
    group.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), newtons.clone().normalize());
    rod.scale.y = Math.max(length - 0.04, 1e-3);
    rod.position.y = rod.scale.y / 2;
    head.position.y = Math.max(length - 0.025, 0.015);
  };
};
const askedArrow = arrowOf("asked"), madeArrow = arrowOf("measured");

const lineOf = (series, name) => {
  const places = Array.from({ length: frames }, (_, i) => vector(series, i));
  return new THREE.Line(new THREE.BufferGeometry().setFromPoints(places), materialOf(name));
};
world.add(lineOf(trial.target, "path"));
const trail = lineOf(trial.position, "path");
trail.material = new THREE.LineBasicMaterial();
world.add(trail);
const cross = new THREE.LineSegments(
  new THREE.BufferGeometry().setFromPoints([[1, 0, 0], [0, 1, 0], [0, 0, 1]].flatMap((axis) =>
    [-0.06, 0.06].map((k) => new THREE.Vector3(...axis).multiplyScalar(k)))), materialOf("path"));
world.add(cross);

const box = new THREE.Box3().setFromPoints(Array.from({ length: frames }, (_, i) => vector(trial.position, i)));
const floor = new THREE.Group();
const lowest = box.min.z - 0.5, centre = box.getCenter(new THREE.Vector3());
const reach = Math.ceil(2 * Math.max(box.max.x - box.min.x, box.max.y - box.min.y, 1)) / 2 + 1;
const lines = [];
for (let k = -reach; k <= reach + 1e-9; k += 0.25) {
  lines.push(new THREE.Vector3(k, -reach, 0), new THREE.Vector3(k, reach, 0), new THREE.Vector3(-reach, k, 0), new THREE.Vector3(reach, k, 0));
}
floor.add(new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(lines), materialOf("grid")));
floor.position.set(Math.round(centre.x * 4) / 4, Math.round(centre.y * 4) / 4, lowest);
world.add(floor);
if (Math.max(box.max.x - box.min.x, box.max.y - box.min.y) > 0.5) element("follow").checked = false;
const wide = Math.max(box.max.x - box.min.x, box.max.y - box.min.y);
if (!element("follow").checked) view.far = 1.2 + 1.35 * wide;

const units = ["N", "N", "N", "N m", "N m", "N m"];
const rows = trial.axes.map((name, i) => {
  const row = element("values").insertRow(), head = document.createElement("th");
  head.scope = "row";
  head.textContent = `${name} [${units[i]}]`;
  row.append(head);
  return [row.insertCell(), row.insertCell()];
});
const panels = [{ name: "off the path", unit: "cm", series: trial.off_cm }, { name: "angle to it", unit: "degrees", series: trial.tilt_deg }];

function drawTraces(frame) {
  const { pen, width, height } = prepare(element("traces"));
  const layout = { left: 44, right: width - 10, each: (height - 100) / 2, top: (k) => 22 + k * ((height - 100) / 2 + 34) };
  const x = (time) => layout.left + ((layout.right - layout.left) * time * trial.rate_hz) / frames;
  panels.forEach((panel, k) => {
    const top = layout.top(k), high = Math.max(...panel.series) * 1.05 || 1;
    const y = (value) => top + layout.each * (1 - value / high);
    drawAxis(pen, layout, panel, top, 0, high, stepOf(0, high, 3), y);
    pen.strokeStyle = colours.measured;
    pen.lineWidth = 1.4;
    pen.beginPath();
    panel.series.forEach((value, i) => (i ? pen.lineTo(x(i / trial.rate_hz), y(value)) : pen.moveTo(x(0), y(value))));
    pen.stroke();
    rule(pen, x(frame / trial.rate_hz), top, layout.each, colours.text, []);
  });
  drawTime(pen, layout, 1, 0, frames / trial.rate_hz, x, "time [s]");
}

function tell(frame) {
  element("now").textContent = (frame / trial.rate_hz).toFixed(2) + " s";
  const lost = [];
  rows.forEach(([asked, made], i) => {
    asked.textContent = numeral(trial.asked[6 * frame + i], 2);
    made.textContent = numeral(trial.driven[6 * frame + i], 2);
    const given = trial.given_up[6 * frame + i] === 1;
    asked.className = given ? "lost" : "";
    if (given) lost.push(trial.axes[i]);
  });
  element("lost").innerHTML = lost.length ? `<span class="lost">beyond the fins' reach: ${lost.join(", ")}</span>` : "\u00a0";
}

function look() {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    renderer.setPixelRatio(ratio);
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
  }
  const flat = view.far * Math.cos(view.tilt);
  camera.position.set(view.at.x + flat * Math.sin(view.turn), view.at.y + view.far * Math.sin(view.tilt), view.at.z + flat * Math.cos(view.turn));
  camera.lookAt(view.at);
}

function draw() {
  for (const each of [...paints, ...strokes]) each.material.color.set(colours[each.name]);
  trail.material.color.set(colours.measured);
  const frame = Math.min(Math.floor(now), frames - 1), next = Math.min(frame + 1, frames - 1), part = now - frame;
  robot.position.copy(vector(trial.position, frame).lerp(vector(trial.position, next), part));
  robot.quaternion.copy(quaternion(frame).slerp(quaternion(next), part));
  if (points > 1) bend(frame);
  cross.position.copy(vector(trial.target, frame));
  trail.geometry.setDrawRange(0, frame + 1);
  const above = robot.position.clone().add(new THREE.Vector3(0, 0, trial.size[2] / 2 + 0.03));
  const force = (series) => new THREE.Vector3(...series.slice(6 * frame, 6 * frame + 3)).applyQuaternion(robot.quaternion);
  askedArrow(above, force(trial.asked));
  madeArrow(above, force(trial.driven));
  if (element("follow").checked) view.at.copy(robot.position).applyEuler(world.rotation);
  else if (!view.placed) { view.at.copy(centre).applyEuler(world.rotation); view.placed = true; }
  look();
  renderer.render(scene, camera);
  drawTraces(frame);
  tell(frame);
  slider.value = frame;
  slider.setAttribute("aria-valuetext", element("now").textContent);
}

function advance(time) {
  if (!playing) return;
  if (last !== null) now += ((time - last) / 1000) * trial.rate_hz * Number(element("speed").value);
  last = time;
  if (now >= frames - 1) { now = frames - 1; set(false); }
  redraw();
  if (playing) requestAnimationFrame(advance);
}

function set(on) {
  if (on && now >= frames - 1) now = 0;
  playing = on;
  last = null;
  play.textContent = on ? "Pause" : "Play";
  if (on) requestAnimationFrame(advance);
}

function go(frame) {
  now = Math.min(Math.max(frame, 0), frames - 1);
  redraw();
}

slider.max = frames - 1;
slider.addEventListener("input", () => { set(false); go(Number(slider.value)); });
play.addEventListener("click", () => set(!playing));
element("follow").addEventListener("change", redraw);
addEventListener("resize", redraw);
addEventListener("keydown", (event) => {
  if (["SELECT", "BUTTON"].includes(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey) return;
  const step = event.shiftKey ? trial.rate_hz : 1;
  const keys = {
    " ": () => set(!playing), ArrowLeft: () => { set(false); go(Math.floor(now) - step); }, ArrowRight: () => { set(false); go(Math.floor(now) + step); },
    Home: () => { set(false); go(0); }, End: () => { set(false); go(frames - 1); },
    f: () => { element("follow").checked = !element("follow").checked; redraw(); },
    "+": () => { view.far /= 1.15; redraw(); }, "-": () => { view.far *= 1.15; redraw(); },
  };
  const act = keys[event.key] || keys[event.key.toLowerCase()];
  if (act) { act(); event.preventDefault(); }
});

/* One finger or the mouse rotates; two fingers or Shift pan; two fingers or the wheel zoom. */
const held = new Map();
const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); held.set(event.pointerId, [event.clientX, event.clientY]); });
for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => held.delete(event.pointerId));
canvas.addEventListener("pointermove", (event) => {
  const from = held.get(event.pointerId);
  if (!from) return;
  const before = held.size === 2 ? spread() : 0;
  held.set(event.pointerId, [event.clientX, event.clientY]);
  const [dx, dy] = [event.clientX - from[0], event.clientY - from[1]];
  if (held.size === 2) view.far = Math.min(Math.max((view.far * before) / Math.max(spread(), 1), 0.3), 20);
  if (held.size === 2 || event.shiftKey) {
    element("follow").checked = false;
    const right = new THREE.Vector3(1, 0, 0).applyQuaternion(camera.quaternion), up = new THREE.Vector3(0, 1, 0).applyQuaternion(camera.quaternion);
    const scale = view.far / canvas.clientHeight / (held.size === 2 ? 2 : 1);
    view.at.addScaledVector(right, -dx * scale).addScaledVector(up, dy * scale);
    view.placed = true;
  } else {
    view.turn -= dx * 0.008;
    view.tilt = Math.min(Math.max(view.tilt + dy * 0.008, -1.5), 1.5);
  }
  redraw();
});
canvas.addEventListener("wheel", (event) => {
  view.far = Math.min(Math.max(view.far * Math.exp(event.deltaY * 0.001), 0.3), 20);
  event.preventDefault();
  redraw();
}, { passive: false });

followColours(["text", "soft", "rule", "body", "fin", "measured", "asked", "path", "grid", "page"]);
