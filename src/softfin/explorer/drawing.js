/* Drawing: the plane of forces, the fin in the water, and the traces. */

const GHOSTS = [24, 18, 12, 6], TRAIL = 300, FORCE_N = 15, MEAN_N = 4, LONGEST = 0.65, MEAN_LONGEST = 0.5;
/* FORCE_N and MEAN_N are the longest arrows of the paper's fin. The page defines finSize. */

/* Corners of the plane without a controller [N], for the paper's fin. */
const BY_HAND = [[-1, -3], [4.5, 3]];

/* A round number, without the digits that floating-point arithmetic adds. */
const short = (value) => Number(value.toPrecision(2));

/* The part of the plane that is shown [N], with room about all targets. */
function planeRange(controllers) {
  const points = controllers.flatMap((each) => [...each.cells.flatMap((cell) => [cell.low, cell.high]), ...(each.reachable ? new Reachable(each.reachable).corners : [])]);
  if (points.length === 0) points.push(...BY_HAND.map((corner) => corner.map((force) => force * finSize)));
  const end = (pick, axis, margin) => pick(...points.map((point) => point[axis])) + margin;
  return { low: [end(Math.min, 0, -0.25 * finSize), end(Math.min, 1, -0.25 * finSize)], high: [end(Math.max, 0, 0.25 * finSize), end(Math.max, 1, 0.25 * finSize)] };
}

/* Pixels of forces on a canvas of that size, the same scale on both axes, and forces of pixels. */
function planeScale(range, width, height) {
  const left = 44, right = 10, top = 10, bottom = 40, wide = width - left - right, tall = height - top - bottom;
  const pixels = Math.min(wide / (range.high[0] - range.low[0]), tall / (range.high[1] - range.low[1]));
  const middle = [0, 1].map((axis) => (range.low[axis] + range.high[axis]) / 2);
  return {
    left, right: width - right, top, bottom: height - bottom, pixels,
    place: ([x, y]) => [left + wide / 2 + pixels * (x - middle[0]), top + tall / 2 - pixels * (y - middle[1])],
    force: (x, y) => [middle[0] + (x - left - wide / 2) / pixels, middle[1] - (y - top - tall / 2) / pixels],
  };
}

function outline(pen, points) {
  pen.beginPath();
  points.forEach((point, i) => (i ? pen.lineTo(...point) : pen.moveTo(...point)));
}

function drawPlane(canvas, range, loop, predicted) {
  const { pen, width, height } = prepare(canvas), scale = planeScale(range, width, height), { place } = scale, { controller } = loop;
  pen.save();
  pen.beginPath();
  pen.rect(scale.left, scale.top, scale.right - scale.left, scale.bottom - scale.top);
  pen.clip();
  pen.fillStyle = controller instanceof Hand ? colours.reach : colours.beyond;
  pen.fillRect(0, 0, width, height);
  pen.fillStyle = colours.reach;
  if (controller.reachable) {
    outline(pen, controller.reachable.corners.map(place));
    pen.closePath();
    pen.fill();
  }
  controller.cells.forEach((cell, index) => {
    const [x, y] = place([cell.low[0], cell.high[1]]), size = [0, 1].map((axis) => (cell.high[axis] - cell.low[axis]) * scale.pixels);
    if (controller.cells.length > 1 && controller.tracked !== null && index === controller.step.activeCell) {
      pen.fillStyle = colours.lit;
      pen.fillRect(x, y, ...size);
    }
    pen.strokeStyle = colours.soft;
    pen.lineWidth = 1;
    pen.setLineDash([5, 4]);
    pen.strokeRect(x, y, ...size);
    pen.setLineDash([]);
  });
  const first = scale.force(scale.left, scale.bottom), last = scale.force(scale.right, scale.top);
  const steps = stepOf(last[1] - first[1], 2 * (last[1] - first[1]), 5), axes = [0, 1].map((axis) => marksOf(first[axis], last[axis], steps));
  pen.strokeStyle = colours.rule;
  for (const axis of [0, 1]) {
    for (const mark of axes[axis].marks) {
      const [x, y] = place([mark, mark]);
      pen.lineWidth = mark === 0 ? 2 : 1;
      outline(pen, axis ? [[scale.left, y], [scale.right, y]] : [[x, scale.top], [x, scale.bottom]]);
      pen.stroke();
    }
  }
  if (controller.reachable) {
    pen.strokeStyle = colours.text;
    pen.lineWidth = 1.5;
    outline(pen, controller.reachable.corners.map(place));
    pen.closePath();
    pen.stroke();
  }
  drawTrail(pen, place, loop);
  drawAsked(pen, place(loop.target()));
  if (controller.feedback !== null && controller.tracked !== null) {
    drawTracked(pen, place(controller.tracked));
    drawInterval(pen, place, scale.pixels, controller.feedback.estimate(), colours.mean);
  }
  if (predicted !== null) drawInterval(pen, place, scale.pixels, predicted, colours.predicted);
  drawMean(pen, place(loop.mean()));
  pen.restore();
  drawPlaneAxes(pen, scale, axes);
}

/* Where the mean force was in the last seconds. */
function drawTrail(pen, place, loop) {
  const last = loop.history.slice(-TRAIL), trail = last.filter((_, i) => (loop.time - last.length + i) % 4 === 0).map((entry) => place(entry.mean));
  pen.strokeStyle = colours.mean;
  pen.lineWidth = 1.5;
  for (let i = 1; i < trail.length; i++) {
    pen.globalAlpha = (0.7 * i) / trail.length;
    outline(pen, [trail[i - 1], trail[i]]);
    pen.stroke();
  }
  pen.globalAlpha = 1;
}

/* A mean force and its interval on both axes: a box with a cross. */
function drawInterval(pen, place, pixels, { mean, half }, colour) {
  const [x, y] = place(mean), [a, b] = half.map((value) => value * pixels);
  pen.strokeStyle = colour;
  pen.lineWidth = 2;
  pen.strokeRect(x - a, y - b, 2 * a, 2 * b);
  outline(pen, [[x - 4, y], [x + 4, y]]);
  pen.stroke();
  outline(pen, [[x, y - 4], [x, y + 4]]);
  pen.stroke();
}

function drawMean(pen, [x, y]) {
  pen.beginPath();
  pen.arc(x, y, 5.5, 0, 2 * Math.PI);
  pen.fillStyle = colours.mean;
  pen.fill();
  pen.strokeStyle = colours.page;
  pen.lineWidth = 1.5;
  pen.stroke();
}

/* The target: a ring with a cross hair, which differs from the dot in shape as well as colour. */
function drawAsked(pen, [x, y]) {
  for (const [colour, width] of [[colours.page, 6], [colours.asked, 3]]) {
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.beginPath();
    pen.arc(x, y, 15, 0, 2 * Math.PI);
    pen.stroke();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      outline(pen, [[x + 12 * dx, y + 12 * dy], [x + 22 * dx, y + 22 * dy]]);
      pen.stroke();
    }
  }
}

/* The reference as force feedback corrects it: a small oblique cross. */
function drawTracked(pen, [x, y]) {
  pen.strokeStyle = colours.asked;
  pen.lineWidth = 2;
  for (const tilt of [1, -1]) {
    outline(pen, [[x - 5, y - 5 * tilt], [x + 5, y + 5 * tilt]]);
    pen.stroke();
  }
}

function drawPlaneAxes(pen, scale, axes) {
  pen.fillStyle = colours.soft;
  pen.textAlign = "center";
  pen.textBaseline = "top";
  for (const mark of axes[0].marks) pen.fillText(numeral(mark, axes[0].digits), scale.place([mark, 0])[0], scale.bottom + 5);
  pen.fillText("mean force x, thrust [N]", (scale.left + scale.right) / 2, scale.bottom + 22);
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (const mark of axes[1].marks) pen.fillText(numeral(mark, axes[1].digits), scale.left - 6, scale.place([0, mark])[1]);
  pen.save();
  pen.translate(9, (scale.top + scale.bottom) / 2);
  pen.rotate(-Math.PI / 2);
  pen.textAlign = "center";
  pen.fillText("mean force y [N]", 0, 0);
  pen.restore();
}

/* The fin, faint where it was in the last quarter of a second, with the forces as arrows; at rest before the first. */
function drawWater(canvas, loop, fin, note) {
  const { pen, width, height } = prepare(canvas), length = fin.length_m;
  const pixels = Math.min(width / (2.1 * length), height / (2.2 * length)), origin = [width / 2 + 0.25 * length * pixels, height / 2];
  const place = ([x, y]) => [origin[0] + pixels * x, origin[1] - pixels * y], last = loop.history.length - 1;
  const vector = ([x, y], longest, most) => [(x * longest * length * pixels) / most, (-y * longest * length * pixels) / most];
  const rest = { angle: 0, shape: null, force: [0, 0], mean: [0, 0], reference: loop.target() };
  pen.fillStyle = colours.fin;
  [...GHOSTS, 0].forEach((ago, i) => {
    const entry = loop.history[Math.max(last - ago, 0)] || rest, straight = [[0, 0], [-length * Math.cos(entry.angle), length * Math.sin(entry.angle)]];
    const shape = entry.shape || straight, thickness = shape.map((_, k) => fin.thickness_m[Math.round((k * (fin.thickness_m.length - 1)) / (shape.length - 1))] * pixels);
    pen.globalAlpha = ago ? 0.05 + 0.04 * i : 1;
    drawFin(pen, shape.map(place), thickness);
  });
  pen.globalAlpha = 1;
  drawFrame(pen, 0.05 * pixels);
  const { force, mean, reference } = loop.history[last] || rest, thick = 0.035 * length * pixels;
  for (const [colour, values, longest, most, wide] of [["asked", reference, MEAN_LONGEST, MEAN_N * finSize, thick], ["measured", force, LONGEST, FORCE_N * finSize, thick], ["mean", mean, MEAN_LONGEST, MEAN_N * finSize, thick / 2]]) {
    pen.fillStyle = colours[colour];
    drawArrow(pen, origin, vector(values, longest, most), wide);
  }
  pen.beginPath();
  pen.arc(...origin, 0.025 * length * pixels, 0, 2 * Math.PI);
  pen.fillStyle = colours.page;
  pen.fill();
  pen.strokeStyle = colours.text;
  pen.lineWidth = 1.5;
  pen.stroke();
  pen.fillStyle = colours.soft;
  pen.textAlign = "left";
  pen.textBaseline = "alphabetic";
  pen.fillText(note, 10, height - 10);
  pen.textAlign = "right";
  const keys = [["measured", `force, ${short((FORCE_N * finSize) / 3)} N`, (LONGEST * length * pixels) / 3, 18], ["mean", `mean over ${Number((WINDOW * TICK_S).toPrecision(2))} s, ${short((MEAN_N * finSize) / 4)} N`, (MEAN_LONGEST * length * pixels) / 4, 36], ["asked", `target, ${short((MEAN_N * finSize) / 4)} N`, (MEAN_LONGEST * length * pixels) / 4, 54]];
  for (const [colour, text, at, y] of Number.isFinite(reference[0]) ? keys : keys.slice(0, 2)) {
    pen.fillStyle = colours[colour];
    pen.fillRect(width - 10 - at, y - 6, at, colour === "mean" ? 2 : 4);
    pen.fillStyle = colours.text;
    pen.fillText(text, width - 16 - at, y);
  }
}

/* The frame in which forces are stated, with axes of 5 cm. */
function drawFrame(pen, length) {
  const x = 12, y = 18 + length;
  pen.fillStyle = colours.soft;
  drawArrow(pen, [x, y], [length, 0], 1.5);
  drawArrow(pen, [x, y], [0, -length], 1.5);
  pen.textAlign = "left";
  pen.textBaseline = "alphabetic";
  pen.fillText("x", x + length + 3, y + 4);
  pen.fillText("y", x - 3, y - length - 5);
  pen.fillText("5 cm", x + 6, y - 6);
}

/* Angle and force over the last ten seconds. */
function drawTraces(canvas, loop) {
  const { pen, width, height } = prepare(canvas), left = 50, right = width - 8, top = 20, gap = 24, each = (height - top - 26 - 2 * gap) / 3;
  const layout = { left, right, each, top: (k) => top + k * (each + gap) }, { history } = loop, end = loop.time * TICK_S, start = Math.max(end - KEPT * TICK_S, 0);
  const span = Math.max(KEPT * TICK_S, 1), x = (time) => left + ((right - left) * (time - start)) / span, offset = loop.time - history.length;
  const least = 3 * finSize;
  const reach = (axis) => least * Math.ceil(history.reduce((most, entry) => Math.max(most, Math.abs(entry.force[axis])), least) / least - 0.1);
  const panels = [
    { name: "angle", unit: "rad", range: [-1.7, 1.7], lines: [["asked", 1.5, (e) => e.command, true], ["measured", 1.3, (e) => e.angle]] },
    ...[0, 1].map((axis) => ({ name: `force ${"xy"[axis]}`, unit: "N", range: [-reach(axis), reach(axis)], lines: [["measured", 1, (e) => e.force[axis]], ["asked", 2, (e) => e.reference[axis], true], ["mean", 2, (e) => e.mean[axis]]] })),
  ];
  panels.forEach((panel, k) => {
    const [low, high] = panel.range, y = (value) => layout.top(k) + (each * (high - value)) / (high - low);
    drawAxis(pen, layout, panel, layout.top(k), low, high, stepOf(low, high, 4), y);
    pen.save();
    pen.beginPath();
    pen.rect(left, layout.top(k), right - left, each);
    pen.clip();
    for (const [colour, thick, of, steps] of panel.lines) {
      pen.strokeStyle = colours[colour];
      pen.lineWidth = thick;
      pen.beginPath();
      // No more points than half the pixels: a thousand a line would cost more than the fin.
      const stride = steps ? 1 : Math.max(1, Math.floor((2 * history.length) / (right - left)));
      let before = null;
      // The same ticks from frame to frame, or the line would shimmer.
      for (let i = (stride - (offset % stride)) % stride; i < history.length; i += stride) {
        const value = of(history[i]);
        if (steps && value === before && i < history.length - 1) continue;
        const at = x((offset + i + 1) * TICK_S);
        // Across a gap without a target there is no line.
        if (steps && Number.isFinite(before)) pen.lineTo(at, y(before));
        else if (steps) pen.moveTo(at, y(value));
        pen.lineTo(at, y(value));
        before = value;
      }
      pen.stroke();
    }
    pen.restore();
  });
  pen.fillStyle = colours.soft;
  pen.textAlign = "center";
  pen.textBaseline = "top";
  for (const mark of marksOf(start, start + span, 2).marks) {
    if (x(mark) < right - 8) pen.fillText(mark === marksOf(start, start + span, 2).marks[0] ? `${mark} s` : `${mark}`, x(mark), layout.top(2) + each + 6);
  }
}
