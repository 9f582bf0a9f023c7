"use strict";

/* canvas.js */

const footage = JSON.parse(document.getElementById("footage").textContent);
const { scale, ticks, points, window: span } = footage;
const tank = element("tank"), traces = element("traces"), slider = element("time"), play = element("play");
const force = footage.force_known ? "true force" : "force";
const panels = [
  { name: "angle", unit: "rad", measured: footage.angle, asked: footage.command, mean: null, range: scale.angle, decimals: 2 },
  { name: `${force} x`, unit: "N", measured: footage.force_x, asked: footage.reference_x || null, mean: footage.mean_x, range: scale.force, decimals: footage.decimals },
  { name: `${force} y`, unit: "N", measured: footage.force_y, asked: footage.reference_y || null, mean: footage.mean_y, range: scale.force, decimals: footage.decimals },
];

let now = 0, playing = false, hovered = null, last = null, coming = null;

const meanAt = (panel, tick) => (panel.mean && tick >= span - 1 ? panel.mean[tick - span + 1] : null);
const secondsAt = (tick) => ((tick + 1) / footage.rate_hz).toFixed(2) + " s";
const shapeAt = (tick) => Array.from({ length: points }, (_, i) => [
  footage.shape[2 * (tick * points + i)] * footage.shape_unit_m, footage.shape[2 * (tick * points + i) + 1] * footage.shape_unit_m]);

function drawTank(tick) {
  const { pen, width, height } = prepare(tank);
  const margin = { left: 12, right: 12, top: footage.reference_x ? 56 : 34, bottom: 30 };
  const metres = [scale.x[1] - scale.x[0], scale.y[1] - scale.y[0]];
  const pixels = Math.min((width - margin.left - margin.right) / metres[0], (height - margin.top - margin.bottom) / metres[1]);
  const origin = [
    margin.left + (width - margin.left - margin.right) / 2 - (pixels * (scale.x[0] + scale.x[1])) / 2,
    margin.top + (height - margin.top - margin.bottom) / 2 + (pixels * (scale.y[0] + scale.y[1])) / 2,
  ];
  const place = ([x, y]) => [origin[0] + pixels * x, origin[1] - pixels * y];
  const vector = (x, y, metres) => [x * metres * pixels, -y * metres * pixels];
  const thick = 0.035 * scale.length_m * pixels, thickness = footage.thickness.map((metres) => metres * pixels);

  pen.strokeStyle = colours.grid;
  pen.lineWidth = 1;
  const spacing = 0.05;
  pen.beginPath();
  for (let k = Math.ceil(-origin[0] / (spacing * pixels)); origin[0] + k * spacing * pixels < width; k++) {
    pen.moveTo(origin[0] + k * spacing * pixels, 0);
    pen.lineTo(origin[0] + k * spacing * pixels, height);
  }
  for (let k = Math.ceil(-origin[1] / (spacing * pixels)); origin[1] + k * spacing * pixels < height; k++) {
    pen.moveTo(0, origin[1] + k * spacing * pixels);
    pen.lineTo(width, origin[1] + k * spacing * pixels);
  }
  pen.stroke();

  pen.fillStyle = colours.fin;
  footage.trail.slice().reverse().forEach((ago, i) => {
    pen.globalAlpha = 0.04 + (0.12 * i) / (footage.trail.length - 1);
    drawFin(pen, shapeAt(Math.max(tick - ago, 0)).map(place), thickness);
  });
  pen.globalAlpha = 1;
  drawFin(pen, shapeAt(tick).map(place), thickness);
  if (footage.reference_x) {
    pen.fillStyle = colours.asked;
    drawArrow(pen, origin, vector(footage.reference_x[tick], footage.reference_y[tick], scale.metres_per_mean_newton), thick);
  }
  pen.fillStyle = colours.measured;
  drawArrow(pen, origin, vector(footage.force_x[tick], footage.force_y[tick], scale.metres_per_newton), thick);
  if (meanAt(panels[1], tick) !== null) {
    pen.fillStyle = colours.mean;
    drawArrow(pen, origin, vector(meanAt(panels[1], tick), meanAt(panels[2], tick), scale.metres_per_mean_newton), thick / 2);
  }
  pen.beginPath();
  pen.arc(...origin, 0.025 * scale.length_m * pixels, 0, 2 * Math.PI);
  pen.fillStyle = colours.shaft;
  pen.fill();
  pen.strokeStyle = colours.text;
  pen.lineWidth = 1.5;
  pen.stroke();
  drawKeys(pen, width, height, pixels, tick, thick);
}

function drawKeys(pen, width, height, pixels, tick, thick) {
  pen.fillStyle = colours.text;
  pen.textAlign = "left";
  pen.textBaseline = "alphabetic";
  pen.font = "600 15px system-ui, sans-serif";
  pen.fillText(secondsAt(tick), 12, 23);
  pen.font = "13px system-ui, sans-serif";
  const key = (length, text, y, colour) => {
    pen.fillStyle = colour;
    pen.textAlign = "right";
    pen.fillText(text, width - 12, y);
    const end = width - 18 - pen.measureText(text).width;
    pen.fillRect(end - length, y - 6, length, 3);
  };
  key(scale.key_n * scale.metres_per_newton * pixels, `${force} ${scale.key_n} N`, 22, colours.measured);
  if (footage.reference_x) {
    key(scale.mean_key_n * scale.metres_per_mean_newton * pixels, `target, mean ${scale.mean_key_n} N`, 44, colours.mean);
  }
  key(0.05 * pixels, "5 cm", height - 12, colours.soft);
}

function tracesLayout(width, height) {
  const left = 58, right = 10, top = 22, bottom = 38, gap = 26;
  const each = (height - top - bottom - 2 * gap) / 3;
  return { left, right: width - right, each, top: (k) => top + k * (each + gap), x: (tick) => left + ((width - right - left) * (tick + 1)) / ticks };
}

function drawTraces(tick, pointed) {
  const { pen, width, height } = prepare(traces);
  const layout = tracesLayout(width, height);
  panels.forEach((panel, k) => {
    const top = layout.top(k), [low, high] = panel.range;
    const y = (value) => top + (layout.each * (high - value)) / (high - low);
    drawAxis(pen, layout, panel, top, low, high, stepOf(low, high, 4), y);
    const line = (series, first, from, to, colour, thickness, alpha, steps) => {
      pen.globalAlpha = alpha;
      pen.strokeStyle = colour;
      pen.lineWidth = thickness;
      pen.beginPath();
      for (let i = Math.max(from, first); i <= to; i++) {
        const value = y(series[i - first]);
        if (i > Math.max(from, first) && steps) pen.lineTo(layout.x(i - 1), value);
        pen.lineTo(layout.x(i), value);
      }
      pen.stroke();
      pen.globalAlpha = 1;
    };
    const whole = (from, to, alpha) => {
      if (panel.asked !== null) line(panel.asked, 0, from, to, colours.asked, 1.6, alpha, true);
      line(panel.measured, 0, from, to, colours.measured, 1.3, alpha, false);
      if (panel.mean && ticks >= span) line(panel.mean, span - 1, from, to, colours.mean, 2, alpha, false);
    };
    whole(tick, ticks - 1, Number(colours.faint));
    whole(0, tick, 1);
    rule(pen, layout.x(tick), top, layout.each, colours.text, []);
    if (pointed !== null) {
      const value = panel.measured[pointed];
      drawPointed(pen, layout, top, layout.x(pointed), y(value), `${numeral(value, panel.decimals)} ${panel.unit}`);
    }
  });
  drawTime(pen, layout, 2, 0, ticks / footage.rate_hz, (time) => layout.x(time * footage.rate_hz - 1), "time [s]");
}

const rows = cellsOf(panels);

function tell(tick) {
  element("now").textContent = secondsAt(tick);
  panels.forEach((panel, k) => {
    const values = [panel.measured[tick], panel.asked === null ? null : panel.asked[tick], meanAt(panel, tick)];
    values.forEach((value, i) => { rows[k][i].textContent = value === null ? "\u2013" : numeral(value, panel.decimals); });
  });
}

function draw() {
  const tick = Math.floor(now);
  drawTank(tick);
  drawTraces(tick, hovered);
  tell(hovered === null ? tick : hovered);
  slider.value = tick;
  slider.setAttribute("aria-valuetext", secondsAt(tick));
}

function advance(time) {
  if (!playing) return;
  const speed = Number(element("speed").value);
  if (last !== null) now += ((time - last) / 1000) * footage.rate_hz * speed;
  last = time;
  if (now >= ticks) now %= ticks;
  draw();
  coming = requestAnimationFrame(advance);
}

function setPlaying(value) {
  if (value === playing) return;
  playing = value;
  last = null;
  play.textContent = playing ? "Pause" : "Play";
  cancelAnimationFrame(coming);
  if (playing) coming = requestAnimationFrame(advance);
}

function goTo(tick) {
  now = Math.min(Math.max(tick, 0), ticks - 1);
  redraw();
}

function tickUnder(event) {
  const box = traces.getBoundingClientRect(), layout = tracesLayout(box.width, box.height);
  const share = (event.clientX - box.left - layout.left) / (layout.right - layout.left);
  return Math.min(Math.max(Math.round(share * ticks) - 1, 0), ticks - 1);
}

play.addEventListener("click", () => setPlaying(!playing));
slider.max = ticks - 1;
slider.addEventListener("input", () => { setPlaying(false); goTo(Number(slider.value)); });
traces.addEventListener("pointermove", (event) => {
  hovered = tickUnder(event);
  if (event.buttons & 1) goTo(hovered);
  redraw();
});
traces.addEventListener("pointerdown", (event) => { setPlaying(false); goTo(tickUnder(event)); });
for (const name of ["pointerleave", "pointercancel"]) traces.addEventListener(name, () => { hovered = null; redraw(); });
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target === element("speed")) return;
  const step = event.shiftKey ? 10 : 1;
  const moves = { ArrowLeft: Math.floor(now) - step, ArrowRight: Math.floor(now) + step, Home: 0, End: ticks - 1 };
  if (event.key === " " && event.target !== play) setPlaying(!playing);
  else if (event.key in moves) { setPlaying(false); goTo(moves[event.key]); }
  else return;
  event.preventDefault();
});

followColours(["page", "text", "soft", "rule", "grid", "fin", "measured", "asked", "mean", "shaft", "faint"]);
new ResizeObserver(redraw).observe(document.querySelector("main"));
if (!matchMedia("(prefers-reduced-motion: reduce)").matches) setPlaying(true);
