/* Feedback (softfin.control.feedback): a Kalman filter estimates what has become of the fin and of its sensor, and the
 * reference is corrected for the fin only. In order, its state holds the coefficients of the family, the six affine
 * parameters of the rest of the error, the drift, and the friction and torque constant of the drive. */

/* Features of an action: force (x, y), angle, and torque and power, first of the fin, then of the motor. */
const FEATURES = 7, FORCES = [0, 1], LOADS = 3, MOTOR = 5, AFFINE = 6;
const FIXED_POINT_STEPS = 2, REPEATED = 20, NEW_REFERENCE = 0.1, SUDDEN = 3, UNFAMILIAR = 6, HALF_90 = 1.645, FRICTION_SHARE = 0.1;
const WHITE_NOISE = [0.02, 0.02, 0.002, 0.01, 0.01, 0.01, 0.01];
/* Whether feedback may use a feature. */
const USABLE = { force: (feature) => feature < LOADS, torque: (feature) => feature > FORCES[1], both: () => true };

/* How the fins that a fin may become differ from it (softfin.control.family). */
class Family {
  constructor(tables) {
    for (const [name, table] of Object.entries(tables)) this[name] = decoded(table);
    this.coefficients = this.force.shape[2];
  }

  /* A table at a reference, linear in x and y; of one action where it has actions. */
  at(table, reference, action = null) {
    const [[i, x], [j, y]] = [0, 1].map((axis) => {
      const last = table.shape[axis] - 1, low = this.low.values[axis], width = this.high.values[axis] - low;
      const place = clip(((reference[axis] - low) / width) * last, 0, last - 1e-5), corner = Math.floor(place);
      return [corner, place - corner];
    });
    const corners = [[i, j, (1 - x) * (1 - y)], [i, j + 1, (1 - x) * y], [i + 1, j, x * (1 - y)], [i + 1, j + 1, x * y]];
    let sum = null;
    for (const [right, up, weight] of corners) {
      const node = part(part(table, right), up), values = (action === null ? node : part(node, action)).values;
      sum = sum === null ? values.map((value) => weight * value) : sum.map((value, k) => value + weight * values[k]);
    }
    return sum;
  }
}

/* Share of an action in a window. */
const shareOf = (action) => ACTION_TICKS[action % ACTION_TICKS.length] / WINDOW;

class Feedback {
  /* `begun` is the number of its first action since the start of the controller's clock. */
  constructor({ config, family }, cells, reachable, uses, begun) {
    Object.assign(this, { config, reachable, uses, begun, age: begun, level: 1, used: null });
    this.family = family === null ? null : new Family(family);
    this.coefficients = this.family === null ? 0 : this.family.coefficients;
    this.size = this.coefficients + AFFINE + 4;
    this.drifts = [this.coefficients + AFFINE, this.coefficients + AFFINE + 1];
    this.cells = cells.map(({ low, high }) => ({ low: low.map(Math.fround), high: high.map(Math.fround) }));
    this.mean = new Float64Array(this.size);
    // The sensor has just been zeroed.
    this.covariance = Array.from(this.mean, (_, i) => each(this.size, (j) => Number(i === j && !this.drifts.includes(i))));
    // Oldest first.
    this.seen = Array.from({ length: WINDOW_ACTIONS }, () => Array(FEATURES).fill(NaN));
    this.tracked = Array.from({ length: WINDOW_ACTIONS + 1 }, () => [0, 0]);
    this.references = this.tracked;
  }

  /* The reference for the controller inside, from what was measured since the last action. */
  correct({ force, angle, shaft = [NaN, NaN], motor = [NaN, NaN] }, reference) {
    this.seen = [...this.seen.slice(1), [...force, angle, ...shaft, ...motor]];
    if (this.age % WINDOW_ACTIONS === 0 && this.age > this.begun) this.update();
    let tracked = reference.map((value, axis) => value + this.tracked.at(-1)[axis] - this.references.at(-1)[axis]);
    for (let k = 0; k < FIXED_POINT_STEPS; k++) {
      const bias = this.bias(tracked);
      tracked = this.trackable(reference, reference.map((value, axis) => value - bias[axis]));
    }
    this.tracked = [...this.tracked.slice(1), tracked];
    this.references = [...this.references.slice(1), reference];
    this.age++;
    return tracked;
  }

  /* The true mean force at the corrected reference, the half-width of its 90% interval, and what the family explains. */
  estimate() {
    const tracked = this.tracked.at(-1), rows = this.biasRows(tracked);
    const half = rows.map((row, axis) => {
      const spread = this.family === null ? 0 : this.family.force_noise.values[axis];
      return HALF_90 * Math.sqrt(dot(row, this.covariance.map((other) => dot(other, row))) + spread ** 2 + this.config.rest_n ** 2);
    });
    return { mean: rows.map((row, axis) => tracked[axis] + dot(row, this.mean)), half, level: this.level };
  }

  /* Derivatives of the affine part of the force error [N]. */
  affine([x, y]) {
    const bias = this.config.bias_n, slope = bias / this.config.reach_n;
    return [[bias, 0, slope * x, slope * y, 0, 0], [0, bias, 0, 0, slope * x, slope * y]];
  }

  /* Derivatives of the force error (x, y) [N] by the state. */
  biasRows(reference) {
    const force = this.family === null ? [] : this.family.at(this.family.force, reference), affine = this.affine(reference);
    return FORCES.map((axis) => Float64Array.from([...force.filter((_, k) => k % 2 === axis), ...affine[axis], 0, 0, 0, 0]));
  }

  bias(reference) {
    const { limit_n } = this.config;
    return this.biasRows(reference).map((row) => clip(dot(row, this.mean), -limit_n, limit_n));
  }

  /* One step of the Kalman filter, with the window that has just ended. */
  update() {
    const { config, size, coefficients } = this, seconds = WINDOW * TICK_S, kept = new Float64Array(size).fill(1), added = new Float64Array(size);
    const keptDrift = Math.exp(-seconds / (2 * config.drift_s));
    added.fill(seconds / config.change_s, 0, coefficients);
    for (const i of this.drifts) [kept[i], added[i]] = [keptDrift, 1 - keptDrift ** 2];
    const mean = this.mean.map((value, i) => kept[i] * value);
    let covariance = this.covariance.map((row, i) => row.map((value, j) => value * kept[i] * kept[j] + (i === j ? added[i] : 0)));
    const moved = this.moved(), { rows, errors, weights } = this.measurements(mean, moved);
    const measured = weights.filter((weight) => weight > 0).length, patterns = weights.slice(2).filter((weight) => weight > 0).length;
    const lowered = (level) => weights.map((weight, i) => (i < 2 ? weight : weight / level));
    const opened = (count) => covariance.map((row, i) => row.map((value, j) => value + (i === j && i < count ? 1 : 0)));
    let found = corrected(covariance, rows, errors, lowered(this.level));
    const sudden = found.innovation / Math.max(measured, 1) > SUDDEN;
    if (sudden) {
      covariance = opened(coefficients);
      found = corrected(covariance, rows, errors, lowered(this.level));
    }
    const left = errors.map((error, i) => error - dot(rows[i], found.change));
    const unexplained = left.reduce((sum, value, i) => sum + (i < 2 ? 0 : weights[i] * value ** 2), 0) / Math.max(patterns, 1);
    // Where no coefficients explain the pattern, the mean force decides.
    const strange = Math.max(unexplained, 1);
    if (sudden && unexplained > UNFAMILIAR) covariance = opened(coefficients + AFFINE);
    found = corrected(covariance, rows, errors, lowered(strange));
    this.mean = mean.map((value, i) => value + found.change[i]);
    this.covariance = found.covariance.map((row, i) => row.map((value, j) => (value + found.covariance[j][i]) / 2));
    if (patterns > 0) this.level = (this.level + strange) / 2;
    if (measured > 0 && moved < NEW_REFERENCE * config.reach_n) this.used = this.centre();
  }

  /* Mean of the corrected references over the last window. */
  centre() {
    return FORCES.map((axis) => this.tracked.slice(1).reduce((sum, force, k) => sum + force[axis] * shareOf(k), 0));
  }

  /* Largest step of a reference, corrected or not, within the last window. */
  moved() {
    const steps = (series) => series.slice(1).flatMap((value, k) => FORCES.map((axis) => Math.abs(value[axis] - series[k][axis])));
    return Math.max(...steps(this.references), ...steps(this.tracked.slice(1)));
  }

  /* Measurements of the last window: derivatives by the state, differences from the prediction, and weights. */
  measurements(mean, moved) {
    const { config, size, coefficients, family, seen } = this, tracked = this.tracked.slice(1);
    // What the model does not explain at a reference is the same in every window there.
    const centre = this.centre(), distance = this.used === null ? Infinity : distanceTo(centre, this.used) / config.reach_n;
    const repeated = REPEATED - (REPEATED - 1) * Math.min(distance / NEW_REFERENCE, 1);
    const rows = [], errors = [], weights = [], affine = this.affine(centre), drift = Math.sqrt(2) * config.drift_n;
    // The start of the fin is not like any other window.
    const counts = this.age >= 2 * WINDOW_ACTIONS && this.age - this.begun >= WINDOW_ACTIONS;
    const add = (feature, row, error, variance) => {
      const valid = Number.isFinite(error);
      rows.push(row);
      errors.push(valid ? error - dot(row, mean) : 0);
      weights.push(valid && counts && USABLE[this.uses](feature) ? 1 / variance : 0);
    };
    const lookUp = (name, force, k) => (family === null ? null : family.at(family[name], force, k));
    const nominal = tracked.map((force, k) => lookUp("nominal", force, k)), rough = tracked.map((force) => lookUp("nominal_noise", force));
    const friction = tracked.map((force, k) => lookUp("friction", force, k)), tables = tracked.map((force, k) => lookUp("features", force, k));
    // Change of a feature of an action by a coefficient.
    const change = (k, coefficient, feature) => tables[k][coefficient * FEATURES + feature];
    const over = (value) => tracked.reduce((sum, _, k) => sum + shareOf(k) * value(k), 0);
    for (const axis of FORCES) {
      const row = new Float64Array(size);
      for (let c = 0; c < coefficients; c++) row[c] = over((k) => change(k, c, axis));
      row.set(affine[axis], coefficients);
      row[this.drifts[axis]] = drift;
      add(axis, row, over((k) => seen[k][axis]) - centre[axis], config.noise_n ** 2 + repeated * config.rest_n ** 2 + moved ** 2);
    }
    if (family === null) return { rows, errors, weights };
    const spread = family.feature_spread.values, noise = family.feature_noise.values;
    for (let k = 0; k < tracked.length; k++) {
      for (let feature = 0; feature < FEATURES; feature++) {
        const row = new Float64Array(size), relative = feature < 2;
        // Drift and the affine error are the same in every action of a window, so the pattern of the forces is relative to their mean.
        for (let c = 0; c < coefficients; c++) row[c] = change(k, c, feature) - (relative ? over((m) => change(m, c, feature)) : 0);
        const ahead = (m) => seen[m][feature] - nominal[m][feature], error = ahead(k) - (relative ? over(ahead) : 0);
        if (feature >= MOTOR) {
          row[size - 2] = FRICTION_SHARE * spread[MOTOR] * friction[k][feature - MOTOR];
          row[size - 1] = config.torque_scale * nominal[k][feature];
        }
        const white = WHITE_NOISE[feature] * (feature < LOADS ? 1 : spread[feature]);
        add(feature, row, error, repeated * noise[feature] ** 2 + white ** 2 + rough[k][feature] ** 2 + ((spread[feature] * moved) / config.reach_n) ** 2);
      }
    }
    return { rows, errors, weights };
  }

  /* The corrected reference within reach and within the cells: between cells it ends at the edge of the reference's own. */
  trackable(reference, corrected) {
    if (this.reachable !== null) corrected = this.reachable.project(corrected);
    if (this.cells.some((cell) => distanceTo(withinCell(cell, corrected), corrected) === 0)) return corrected;
    return withinCell(nearestCellTo(this.cells, reference), corrected);
  }
}

/* The update of a Kalman filter by independent measurements: change of the mean, covariance, and squared innovation. */
function corrected(covariance, rows, errors, weights) {
  const size = covariance.length, information = covariance.map(() => new Float64Array(size)), pull = new Float64Array(size);
  let square = 0;
  rows.forEach((row, m) => {
    for (let i = 0; i < size; i++) {
      const weighted = weights[m] * row[i];
      for (let j = 0; j < size; j++) information[i][j] += weighted * row[j];
      pull[i] += weighted * errors[m];
    }
    square += weights[m] * errors[m] ** 2;
  });
  const left = covariance.map((row, i) => {
    const sums = new Float64Array(size);
    sums[i] = 1;
    for (let k = 0; k < size; k++) for (let j = 0; j < size; j++) sums[j] += row[k] * information[k][j];
    return sums;
  });
  const after = solved(left, covariance), change = after.map((row) => dot(row, pull));
  return { change, covariance: after, innovation: square - dot(pull, change) };
}
