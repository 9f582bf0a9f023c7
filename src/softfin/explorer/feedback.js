/* Feedback (softfin.control.feedback): a Kalman filter estimates the change of the fin and the drift of the sensor, and
 * the reference is corrected for the fin only. The state of the filter contains, in this order, the coefficients of the
 * family, the six parameters of the affine error, the local error at the current reference (x, y), the drift (x, y), and
 * the friction and the error of the torque constant of the drive. */

/* Features of an action: force (x, y), angle, and torque and power, first on the fin, then of the motor. */
const FEATURES = 7, FORCES = [0, 1], LOADS = 3, MOTOR = 5, AFFINE = 6, PLACE = 2;
const FIXED_POINT_STEPS = 2, STARTS = 0.3, NEAR = 0.15, REPEATED = 20, NEW_REFERENCE = 0.1, SUDDEN = 6, FAR_SQUARED = 4, LIKELIER = 20, JUMP = 0.1, CLEAR = 1.5, UNFAMILIAR = 4, HALF_90 = 1.645, FRICTION_SHARE = 0.1;
const WHITE_NOISE = [0.02, 0.02, 0.002, 0.01, 0.01, 0.01, 0.01];
/* Whether feedback may use a feature, for each setting. */
const USABLE = { force: (feature) => feature < LOADS, torque: (feature) => feature > FORCES[1], both: () => true };

/* The ways in which a fin may change (softfin.control.family). */
class Family {
  constructor(tables) {
    for (const [name, table] of Object.entries(tables)) this[name] = decoded(table);
    this.coefficients = this.force.shape[2];
  }

  /* A table interpolated at a reference, linearly in x and y; for one action if the table has an action axis. */
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
  /* `begun` is the number of the first action with feedback, counted from the start of the controller's clock. */
  constructor({ config, family }, cells, reachable, uses, begun) {
    Object.assign(this, { config, reachable, uses, begun, age: begun, level: 1, used: null, wasMixed: false, zero: [0, 0] });
    this.family = family === null ? null : new Family(family);
    this.coefficients = this.family === null ? 0 : this.family.coefficients;
    this.size = this.coefficients + AFFINE + PLACE + 4;
    this.places = [this.coefficients + AFFINE, this.coefficients + AFFINE + 1];
    this.drifts = this.places.map((place) => place + PLACE);
    this.cells = cells.map(({ low, high }) => ({ low: low.map(Math.fround), high: high.map(Math.fround) }));
    this.mean = new Float64Array(this.size);
    // The sensor has just been zeroed.
    const variances = this.mean.map((_, i) => (i < this.coefficients ? STARTS ** 2 : Number(!this.drifts.includes(i))));
    this.covariance = Array.from(variances, (variance, i) => each(this.size, (j) => (i === j ? variance : 0)));
    // Oldest first.
    this.seen = Array.from({ length: WINDOW_ACTIONS }, () => Array(FEATURES).fill(NaN));
    this.tracked = Array.from({ length: WINDOW_ACTIONS + 1 }, () => [0, 0]);
    this.references = this.tracked;
  }

  /* The reference for the inner controller, from the measurements since the last action. */
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

  /* The estimated true mean force at the corrected reference, the half-width of its 90% interval, and the level of the
   * unexplained pattern. */
  estimate() {
    const tracked = this.tracked.at(-1), near = this.near(tracked), rows = this.biasRows(tracked, near);
    const half = rows.map((row, axis) => {
      const spread = this.family === null ? 0 : this.family.force_noise.values[axis];
      return HALF_90 * Math.sqrt(dot(row, this.covariance.map((other) => dot(other, row))) + spread ** 2 + (1 - near ** 2) * this.config.rest_n ** 2);
    });
    return { mean: rows.map((row, axis) => tracked[axis] + dot(row, this.mean)), half, level: this.level };
  }

  /* Derivatives of the affine part of the force error [N]. */
  affine([x, y]) {
    const bias = this.config.bias_n, slope = bias / this.config.reach_n;
    return [[bias, 0, slope * x, slope * y, 0, 0], [0, bias, 0, 0, slope * x, slope * y]];
  }

  /* Correlation of the local force error at a reference with that of the last window. */
  near(reference) {
    return this.used === null ? 0 : Math.exp(-distanceTo(reference, this.used) / (NEAR * this.config.reach_n));
  }

  /* Derivatives of the force error (x, y) [N] with respect to the state. */
  biasRows(reference, near) {
    const force = this.family === null ? [] : this.family.at(this.family.force, reference), affine = this.affine(reference);
    return FORCES.map((axis) => {
      const row = Float64Array.from([...force.filter((_, k) => k % 2 === axis), ...affine[axis], 0, 0, 0, 0, 0, 0]);
      row[this.places[axis]] = near * this.config.rest_n;
      return row;
    });
  }

  bias(reference) {
    const { limit_n } = this.config;
    return this.biasRows(reference, this.near(reference)).map((row) => clip(dot(row, this.mean), -limit_n, limit_n));
  }

  /* Update the Kalman filter with the window that has just ended. */
  update() {
    const { config, size, coefficients } = this, seconds = WINDOW * TICK_S, centre = this.centre(), moved = this.moved();
    const kept = new Float64Array(size).fill(1), added = new Float64Array(size), near = this.near(centre);
    const keptDrift = Math.exp(-seconds / (2 * config.drift_s));
    added.fill(seconds / config.change_s, 0, coefficients);
    for (const i of this.drifts) [kept[i], added[i]] = [keptDrift, 1 - keptDrift ** 2];
    for (const i of this.places) [kept[i], added[i]] = [near, 1 - near ** 2];
    const mean = this.mean.map((value, i) => kept[i] * value);
    const covariance = this.covariance.map((row, i) => row.map((value, j) => value * kept[i] * kept[j] + (i === j ? added[i] : 0)));
    const { rows, errors, has, variance, unexplained } = this.measurements(mean, moved), patterns = (values) => values.slice(FORCES.length);
    const sum = (values) => values.reduce((total, value) => total + Number(value), 0), counted = sum(patterns(has));
    // The part that the state does not explain is the same in all windows at the same reference.
    const distance = this.used === null ? Infinity : distanceTo(centre, this.used) / config.reach_n;
    const repeated = this.wasMixed ? 1 : REPEATED - (REPEATED - 1) * Math.min(distance / NEW_REFERENCE, 1);
    const weights = (times, level) => has.map((valid, i) => Number(valid) / ((variance[i] + times * unexplained[i]) * (i < FORCES.length ? 1 : level)));
    const correct = (prior, times, level) => corrected(prior, rows, errors, weights(times, level));
    const raised = (prior, more) => prior.map((row, i) => row.map((value, j) => value + (i === j ? more(i) : 0)));
    // Compare three explanations: nothing sudden, a change of the fin, a jump of the sensor.
    const isForgotten = (i) => i < coefficients || this.places.includes(i);
    const byFin = covariance.map((row, i) => row.map((value, j) => (isForgotten(i) || isForgotten(j) ? Number(i === j) : value)));
    const jump = config.drift_n > 0 ? ((JUMP * config.reach_n) / config.drift_n) ** 2 : 0;
    const bySensor = raised(covariance, (i) => (this.drifts.includes(i) ? jump : 0));
    const [nothing, fin, sensor] = [covariance, byFin, bySensor].map((prior) => correct(prior, repeated, this.level));
    const count = Math.max(sum(has), 1), gain = nothing.unlikely - Math.min(fin.unlikely, sensor.unlikely);
    const sudden = nothing.innovation > count + SUDDEN * Math.sqrt(2 * count) || gain > LIKELIER;
    // Without a pattern, both explain a sudden change equally well.
    const canTell = counted > 0 && (has[0] || has[1]) && config.drift_n > 0, isSensor = sudden && canTell && sensor.unlikely < fin.unlikely;
    const prior = isSensor ? bySensor : sudden ? byFin : covariance, times = sudden ? 1 : repeated;
    const { change } = correct(prior, times, 1), plain = weights(1, 1);
    const squares = errors.map((error, i) => plain[i] * (error - dot(rows[i], change)) ** 2);
    // Coefficients that no fin of the family has are as strange as what they do not explain.
    const implied = [...mean.slice(0, coefficients)].map((value, i) => (value + change[i]) ** 2 / FAR_SQUARED);
    const level = Math.max(sum(patterns(squares)) / Math.max(counted, 1), 1, ...implied);
    this.used = centre;
    // A window in which something changed is partly that from before. Unless a constant change explains it, the next one decides.
    const judges = this.age > 2 * WINDOW_ACTIONS && this.age - this.begun >= 2 * WINDOW_ACTIONS;
    if (sudden && !this.wasMixed && level > CLEAR && judges) {
      [this.mean, this.covariance, this.wasMixed] = [mean, covariance, true];
      return;
    }
    // If no coefficients explain the pattern, rely on the mean force.
    const strange = sudden && (level > UNFAMILIAR || coefficients === 0);
    const found = correct(strange ? raised(byFin, (i) => Number(i < coefficients + AFFINE + PLACE)) : prior, times, level);
    this.mean = mean.map((value, i) => value + found.change[i]);
    this.covariance = found.covariance.map((row, i) => row.map((value, j) => (value + found.covariance[j][i]) / 2));
    this.wasMixed = false;
    if (counted > 0) this.level = (this.level + level) / 2;
    if (!isSensor) return;
    // A jump remains, whereas the drift tends to 0.
    this.zero = this.drifts.map((i, axis) => this.zero[axis] + Math.sqrt(2) * config.drift_n * this.mean[i]);
    for (const i of this.drifts) this.mean[i] = 0;
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

  /* Measurements in the last window: derivatives with respect to the state, differences from the prediction, whether each
   * is available and may be used, variance of the noise, and variance of the part that the state does not explain. */
  measurements(mean, moved) {
    const { config, size, coefficients, family, seen } = this, tracked = this.tracked.slice(1);
    const centre = this.centre(), affine = this.affine(centre), found = { rows: [], errors: [], has: [], variance: [], unexplained: [] };
    // Skip the first window, in which the fin starts from rest.
    const counts = this.age >= 2 * WINDOW_ACTIONS && this.age - this.begun >= WINDOW_ACTIONS;
    const add = (feature, row, error, variance, unexplained) => {
      const has = Number.isFinite(error) && USABLE[this.uses](feature);
      const entries = { rows: row, errors: has ? error - dot(row, mean) : 0, has: has && counts, variance, unexplained };
      for (const [name, value] of Object.entries(entries)) found[name].push(value);
    };
    const lookUp = (name, force, k) => (family === null ? null : family.at(family[name], force, k));
    const nominal = tracked.map((force, k) => lookUp("nominal", force, k)), rough = tracked.map((force) => lookUp("nominal_noise", force));
    const friction = tracked.map((force, k) => lookUp("friction", force, k)), tables = tracked.map((force, k) => lookUp("features", force, k));
    // Change in a feature of an action per unit of a coefficient.
    const change = (k, coefficient, feature) => tables[k][coefficient * FEATURES + feature];
    const over = (value) => tracked.reduce((sum, _, k) => sum + shareOf(k) * value(k), 0);
    for (const axis of FORCES) {
      const row = new Float64Array(size);
      for (let c = 0; c < coefficients; c++) row[c] = over((k) => change(k, c, axis));
      row.set(affine[axis], coefficients);
      row[this.places[axis]] = config.rest_n;
      row[this.drifts[axis]] = Math.sqrt(2) * config.drift_n;
      add(axis, row, over((k) => seen[k][axis]) - centre[axis] - this.zero[axis], config.noise_n ** 2 + moved ** 2, 0);
    }
    if (family === null) return found;
    const spread = family.feature_spread.values, noise = family.feature_noise.values;
    for (let k = 0; k < tracked.length; k++) {
      for (let feature = 0; feature < FEATURES; feature++) {
        const row = new Float64Array(size), relative = feature < 2;
        // Drift and the force error are the same for all actions of a window, so subtract the mean force to obtain the pattern.
        for (let c = 0; c < coefficients; c++) row[c] = change(k, c, feature) - (relative ? over((m) => change(m, c, feature)) : 0);
        const ahead = (m) => seen[m][feature] - nominal[m][feature], error = ahead(k) - (relative ? over(ahead) : 0);
        if (feature >= MOTOR) {
          row[size - 2] = FRICTION_SHARE * spread[MOTOR] * friction[k][feature - MOTOR];
          row[size - 1] = config.torque_scale * nominal[k][feature];
        }
        const white = WHITE_NOISE[feature] * (feature < LOADS ? 1 : spread[feature]);
        add(feature, row, error, white ** 2 + rough[k][feature] ** 2 + ((spread[feature] * moved) / config.reach_n) ** 2, noise[feature] ** 2);
      }
    }
    return found;
  }

  /* Move the corrected reference into the reachable forces and the cells. Between cells, it stops at the edge of the cell
   * of the original reference. */
  trackable(reference, corrected) {
    if (this.reachable !== null) corrected = this.reachable.project(corrected);
    if (this.cells.some((cell) => distanceTo(withinCell(cell, corrected), corrected) === 0)) return corrected;
    return withinCell(nearestCellTo(this.cells, reference), corrected);
  }
}

/* Update of the Kalman filter for independent measurements: change of the mean, covariance, squared innovation, and how
 * unlikely the measurements are. */
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
  const { solution: after, logDeterminant } = solved(left, covariance), change = after.map((row) => dot(row, pull));
  const innovation = square - dot(pull, change);
  // -2 times the logarithm of the likelihood of the measurements, except for a constant.
  return { change, covariance: after, innovation, unlikely: innovation + logDeterminant };
}
