/* What the pages that draw on a canvas share; each has it inline, so that a page is one file. */

const element = (id) => document.getElementById(id);

let colours = {}, waiting = false;

const numeral = (value, digits) => (value < 0 && Number(value.toFixed(digits)) !== 0 ? "\u2212" : "") + Math.abs(value).toFixed(digits);

/* The force per watt of a mean force [N] and a mean power [W], in the words of softfin.core.power. */
const forcePerWatt = (thrust, power) => `${power > 0 ? numeral(thrust / power, 2) : "-"} N/W`;

/* A canvas in CSS pixels, sharp on every screen. */
function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = "13px system-ui, sans-serif";
  return { pen, width, height };
}

function stepOf(low, high, most) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((s) => s * power).find((s) => s >= rough * (1 - 1e-9));
}

function marksOf(low, high, step) {
  const marks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) marks.push(k * step);
  return { marks, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9)) };
}

/* Have the page's `draw` called before the screen is shown next. */
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => { waiting = false; draw(); });
}

/* Take colours from the page's style, now and whenever the screen turns dark or light. */
function followColours(names) {
  const read = () => {
    const style = getComputedStyle(document.documentElement);
    for (const name of names) colours[name] = style.getPropertyValue(`--${name}`).trim();
    redraw();
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", read);
  read();
}

/* A row for each panel in the table of values; the three cells of each. */
function cellsOf(panels) {
  return panels.map((panel) => {
    const row = element("values").insertRow(), head = document.createElement("th");
    head.scope = "row";
    head.textContent = `${panel.name} [${panel.unit}]`;
    row.append(head);
    return [0, 1, 2].map(() => row.insertCell());
  });
}

/* Title, marks and lines of a panel; `y` is the pixel of a value. */
function drawAxis(pen, layout, panel, top, low, high, step, y) {
  pen.lineWidth = 1;
  pen.strokeStyle = colours.rule;
  pen.fillStyle = colours.soft;
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  const { marks, digits } = marksOf(low, high, step);
  for (const mark of marks) {
    pen.beginPath();
    pen.moveTo(layout.left, y(mark));
    pen.lineTo(layout.right, y(mark));
    pen.stroke();
    pen.fillText(numeral(mark, digits), layout.left - 7, y(mark));
  }
  pen.textAlign = "left";
  pen.textBaseline = "alphabetic";
  pen.fillStyle = colours.text;
  pen.fillText(`${panel.name} [${panel.unit}]`, layout.left, top - 8);
}

/* The axis of time below the last panel; `x` is the pixel of a time. */
function drawTime(pen, layout, last, from, to, x, title) {
  pen.fillStyle = colours.soft;
  pen.textBaseline = "top";
  const { marks, digits } = marksOf(from, to, stepOf(from, to, Math.max(3, Math.floor(layout.right / 80))));
  const below = layout.top(last) + layout.each + 5;
  for (const mark of marks) {
    const edge = x(mark) > layout.right - 14;
    pen.textAlign = edge ? "right" : "center";
    pen.fillText(mark.toFixed(digits), edge ? layout.right : x(mark), below);
  }
  pen.textAlign = "center";
  pen.fillText(title, (layout.left + layout.right) / 2, below + 19);
}

function rule(pen, x, top, tall, colour, dashes) {
  pen.strokeStyle = colour;
  pen.lineWidth = 1;
  pen.setLineDash(dashes);
  pen.beginPath();
  pen.moveTo(x, top);
  pen.lineTo(x, top + tall);
  pen.stroke();
  pen.setLineDash([]);
}

/* What was measured where the pointer is: a rule, a dot at a pixel, and a text beside it. */
function drawPointed(pen, layout, top, x, y, text) {
  rule(pen, x, top, layout.each, colours.soft, [4, 3]);
  pen.fillStyle = colours.measured;
  pen.beginPath();
  pen.arc(x, y, 3.5, 0, 2 * Math.PI);
  pen.fill();
  const wide = pen.measureText(text).width + 10, leftwards = x + 8 + wide > layout.right;
  const box = [leftwards ? x - 8 - wide : x + 8, Math.min(Math.max(y - 10, top), top + layout.each - 20)];
  pen.fillStyle = colours.page;
  pen.globalAlpha = 0.9;
  pen.fillRect(...box, wide, 20);
  pen.globalAlpha = 1;
  pen.fillStyle = colours.text;
  pen.textAlign = "left";
  pen.textBaseline = "middle";
  pen.fillText(text, box[0] + 5, box[1] + 10);
}

/* Through the points from the pen's place, smoothly (Catmull and Rom). */
function curve(pen, line) {
  for (let i = 1; i < line.length; i++) {
    const [p, a, b, n] = [line[Math.max(i - 2, 0)], line[i - 1], line[i], line[Math.min(i + 1, line.length - 1)]];
    pen.bezierCurveTo(a[0] + (b[0] - p[0]) / 6, a[1] + (b[1] - p[1]) / 6, b[0] - (n[0] - a[0]) / 6, b[1] - (n[1] - a[1]) / 6, b[0], b[1]);
  }
}

/* A fin along its middle line, with its thickness at each point; both in pixels. */
function drawFin(pen, middle, thickness) {
  const last = middle.length - 1;
  const side = (sign) => middle.map(([x, y], i) => {
    const a = middle[Math.max(i - 1, 0)], b = middle[Math.min(i + 1, last)];
    const length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
    const half = (sign * thickness[i]) / 2;
    return [x - (half * (b[1] - a[1])) / length, y + (half * (b[0] - a[0])) / length];
  });
  const left = side(1), right = side(-1).reverse(), tip = middle[last];
  const start = Math.atan2(left[last][1] - tip[1], left[last][0] - tip[0]);
  pen.beginPath();
  pen.moveTo(...left[0]);
  curve(pen, left);
  pen.arc(tip[0], tip[1], thickness[last] / 2, start, start - Math.PI, true);
  curve(pen, right);
  pen.closePath();
  pen.fill();
}

/* An arrow from a point along a vector, both in pixels. */
function drawArrow(pen, from, vector, width) {
  const length = Math.hypot(...vector);
  if (length < 0.5) return;
  const [ux, uy] = [vector[0] / length, vector[1] / length];
  const head = Math.min(3.2 * width, 0.6 * length), half = head / 6.4;
  const at = (far, wide) => [from[0] + ux * far - uy * wide, from[1] + uy * far + ux * wide];
  const outline = [[0, half], [length - head, half], [length - head, 3 * half], [length, 0], [length - head, -3 * half], [length - head, -half], [0, -half]];
  pen.beginPath();
  outline.forEach(([far, wide], i) => (i ? pen.lineTo(...at(far, wide)) : pen.moveTo(...at(far, wide))));
  pen.closePath();
  pen.fill();
}
