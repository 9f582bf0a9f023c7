/* Controllers (softfin.control): a reference force in, a command out, once per action. Inputs are rounded to single
 * precision, as there, so that a reference on the edge of a cell belongs to the same cell. */

/* Gaits of one window on a lattice of references, blended between its nodes; in single precision, as with NumPy. */
class GaitTable {
  constructor({ low, high, actions }) {
    [this.low, this.high, this.actions] = [low, high, decoded(actions)];
  }

  /* The action, (angle, velocity) in [-1, 1], of the gait for a reference. */
  action(reference, age) {
    const { fround } = Math, [x, i] = this.place(reference[0], 0), [y, j] = this.place(reference[1], 1);
    const blend = [0, 0], corners = [[0, 0, (1 - x) * (1 - y)], [0, 1, (1 - x) * y], [1, 0, x * (1 - y)], [1, 1, x * y]];
    for (const [right, up, weight] of corners) {
      const actions = part(part(this.actions, i + right), j + up).values.subarray(2 * (age % WINDOW_ACTIONS));
      for (const k of [0, 1]) blend[k] = fround(blend[k] + fround(fround(weight) * actions[k]));
    }
    return blend;
  }

  /* The node before a force, and the distance from it in units of the spacing; in single precision, as there: on a
   * fine lattice its rounding shows in the forces. */
  place(force, axis) {
    const { fround } = Math, last = this.actions.shape[axis] - 1, width = fround(fround(this.high[axis] - this.low[axis]) + fround(1e-9));
    const place = last * clip(fround(fround(force - this.low[axis]) / width), 0, 1), node = Math.min(Math.trunc(place), last - 1);
    return [place - node, node];
  }
}

/* What a policy observes: now (angle, reference x, y), and past actions. */
function observed(task, now, actions) {
  return joined(now, actions.slice(0, 2 * (task.past_actions + 1)));
}

/* An LSTM and the layer behind it; its memory is {hidden, cell}. */
class PolicyNetwork {
  constructor(arrays) {
    Object.assign(this, arrays);
    this.units = this.bias.values.length / 4;
  }

  empty() {
    return { hidden: new Float64Array(this.units), cell: new Float64Array(this.units) };
  }

  remember(memory, observation) {
    const n = this.units, gates = product(joined(observation, memory.hidden), this.kernel, this.bias).map(Math.tanh);
    const opened = (k, i) => 0.5 * gates[k * n + i] + 0.5;
    const cell = memory.cell.map((value, i) => opened(1, i) * value + opened(0, i) * gates[3 * n + i]);
    return { hidden: cell.map((value, i) => opened(2, i) * Math.tanh(value)), cell };
  }

  action(memory) {
    const inner = product(memory.hidden, this.hidden, this.hidden_bias).map(Math.tanh);
    return Array.from(product(inner, this.output, this.output_bias).map(Math.tanh));
  }
}

class GaitController {
  constructor({ table }) {
    this.table = new GaitTable(table);
    this.age = 0;
  }

  act(now) {
    return this.table.action(now.slice(1), this.age++);
  }
}

class SingleController {
  constructor({ network, task, rest }) {
    this.network = new PolicyNetwork(Object.fromEntries(Object.entries(network).map(([name, array]) => [name, decoded(array)])));
    this.task = task;
    this.memory = this.network.empty();
    this.actions = joined(...Array(task.past_actions + 1).fill(rest));
  }

  act(now) {
    this.memory = this.network.remember(this.memory, observed(this.task, now, this.actions));
    const action = this.network.action(this.memory);
    this.actions = joined(action, this.actions.slice(0, -2));
    return action;
  }
}

/* A policy for each cell; after a switch, the new one replays the last observations. */
class GridController {
  constructor({ network, cells, task, rest }) {
    const stacked = Object.entries(network).map(([name, array]) => [name, decoded(array)]);
    this.networks = cells.map((_, index) => new PolicyNetwork(Object.fromEntries(stacked.map(([name, array]) => [name, part(array, index)]))));
    // In single precision, as references are: where cells touch, the same one acts.
    this.cells = cells.map(({ low, high }) => ({ low: low.map(Math.fround), high: high.map(Math.fround) }));
    Object.assign(this, { task, memory: this.networks[0].empty(), age: 0, activeCell: 0 });
    this.actions = joined(...Array(WINDOW_ACTIONS + task.past_actions + 1).fill(rest));
    this.angles = Array(WINDOW_ACTIONS).fill(0);
  }

  act(now) {
    const reference = now.slice(1), cell = this.nearestCell(reference), switched = cell !== this.activeCell && this.age > 0;
    const network = this.networks[cell], memory = switched ? this.warmUp(network, reference) : this.memory;
    this.memory = network.remember(memory, observed(this.task, now, this.actions));
    const action = network.action(this.memory);
    this.actions = joined(action, this.actions.slice(0, -2));
    this.angles = [now[0], ...this.angles.slice(0, -1)];
    this.activeCell = cell;
    this.age++;
    return action;
  }

  /* Index of the cell that contains the reference, or of the nearest one. */
  nearestCell(reference) {
    const distances = this.cells.map((cell) => distanceTo(withinCell(cell, reference), reference));
    return distances.indexOf(Math.min(...distances));
  }

  /* Replay the last cycle, or as much of it as there was, as if the reference had long been this one. */
  warmUp(network, reference) {
    let memory = network.empty();
    for (let ago = Math.min(WINDOW_ACTIONS, this.age); ago > 0; ago--) {
      memory = network.remember(memory, observed(this.task, [this.angles[ago - 1], ...reference], this.actions.slice(2 * ago)));
    }
    return memory;
  }
}

/* Change of the window's error within the last actions, divided by its noise, above which the fin is not settled. */
const UNSTEADY = 3, UNSTEADY_ACTIONS = 3;

/* Force feedback (softfin.control.disturbance_observer): the estimated steady-state error is subtracted from the
 * reference; a Kalman filter separates it from the drift of a sensor. */
class DisturbanceObserver {
  /* `phase` of the clock, 0 to 2, at which it begins. */
  constructor(config, cells, reachable, phase) {
    Object.assign(this, { config, reachable, phase, bias: [0, 0], drift: [0, 0], age: 0 });
    // Variance of the bias, covariance, variance of the drift; the same on both axes.
    this.covariance = [config.bias_n ** 2, 0, 0];
    this.cells = cells.map(({ low, high }) => ({ low: low.map(Math.fround), high: high.map(Math.fround) }));
    const series = () => Array.from({ length: WINDOW_ACTIONS + config.lag_actions }, () => [0, 0]);
    Object.assign(this, { forces: series().slice(0, WINDOW_ACTIONS), tracked: series(), references: series() });
    this.errors = Array.from({ length: UNSTEADY_ACTIONS }, () => [0, 0]);
  }

  /* The reference for the controller inside, from the mean force since the last action. */
  correct(force, reference) {
    const { config } = this, weights = Array.from({ length: WINDOW_ACTIONS }, (_, ago) => ACTION_TICKS[(this.phase + this.age + 2 * WINDOW_ACTIONS - 1 - ago) % ACTION_TICKS.length] / WINDOW);
    this.forces = [force, ...this.forces.slice(0, -1)];
    const before = this.tracked.slice(-WINDOW_ACTIONS);
    this.estimate([0, 1].map((axis) => weights.reduce((sum, weight, k) => sum + weight * (this.forces[k][axis] - before[k][axis]), 0)), reference);
    const tracked = this.trackable(reference, reference.map((value, axis) => value - this.bias[axis]));
    this.tracked = [tracked, ...this.tracked.slice(0, -1)];
    this.references = [reference, ...this.references.slice(0, -1)];
    this.age++;
    return tracked;
  }

  /* One action of the Kalman filter, from the mean force less the mean of the tracked references. */
  estimate(error, reference) {
    const { config } = this, kept = Math.exp(-1 / (ACTION_RATE_HZ * 2 * config.drift_s));
    const distance = Math.max(...reference.map((value, axis) => Math.abs(value - this.references[0][axis])));
    const drift = this.drift.map((value) => kept * value);
    let variance = this.covariance[0] + (this.age > 0 ? config.bias_per_n ** 2 * distance : 0);
    const cross = kept * this.covariance[1], driftVariance = kept ** 2 * this.covariance[2] + (1 - kept ** 2) * 2 * config.drift_n ** 2;
    const range = (axis) => { const values = [reference, ...this.references].map((each) => each[axis]); return Math.max(...values) - Math.min(...values); };
    const change = Math.max(...this.errors.flatMap((each) => each.map((value, axis) => Math.abs(error[axis] - value))));
    const unsteady = Math.max(change / (UNSTEADY * config.noise_n), 1);
    this.errors = [error, ...this.errors.slice(0, -1)];
    const noiseVariance = (config.noise_n * (Math.max(range(0), range(1), config.still_n) / config.still_n) ** 2 * unsteady ** 2) ** 2;
    const innovation = error.map((value, axis) => value - this.bias[axis] - drift[axis]);
    const expected = variance + 2 * cross + driftVariance + noiseVariance, learns = Number(this.age >= config.settle_actions);
    variance += learns * Math.max(Math.max(...innovation.map((value) => value ** 2)) - 9 * expected, 0);
    const total = variance + 2 * cross + driftVariance + WINDOW_ACTIONS * noiseVariance;
    const gain = learns * (variance + cross) / total, driftGain = learns * (cross + driftVariance) / total;
    this.bias = this.bias.map((bias, axis) => clip(bias + gain * innovation[axis], -config.limit_n, config.limit_n));
    this.drift = drift.map((value, axis) => value + driftGain * innovation[axis]);
    this.covariance = [variance - gain * (variance + cross), cross - gain * (cross + driftVariance), driftVariance - driftGain * (cross + driftVariance)];
  }

  /* The corrected reference within reach and within the cells: between cells it ends at the edge of the reference's own. */
  trackable(reference, corrected) {
    if (this.reachable !== null) corrected = this.reachable.project(corrected);
    if (this.cells.some((cell) => distanceTo(withinCell(cell, corrected), corrected) === 0)) return corrected;
    return withinCell(nearestCellTo(this.cells, reference), corrected);
  }
}

const CONTROLLERS = { gaits: GaitController, single: SingleController, grid: GridController };

/* A controller of any kind at rest, with the outer loop about it on demand. */
class Controller {
  constructor(description) {
    // `tracked` is the reference of the last action as the outer loop corrected it, `added` the correction; null before.
    Object.assign(this, { description, limits: description.limits, cells: description.cells, observer: null, tracked: null, added: null });
    this.step = new CONTROLLERS[description.kind](description);
    this.reachable = description.reachable === null ? null : new Reachable(description.reachable);
  }

  /* Begin or end the outer loop, before the action that has this number since the start of the clock. */
  trim(wanted, action) {
    this.observer = wanted ? new DisturbanceObserver(this.description.trim, this.cells, this.reachable, action % ACTION_TICKS.length) : null;
  }

  /* The command for a reference [N], from the angle [rad], and the mean force [N] and torque of the shaft [N m] since
   * the last action. */
  act({ angle, force }, reference) {
    const { limits } = this;
    this.tracked = this.observer === null ? reference : this.observer.correct(force, reference);
    this.added = this.tracked.map((value, axis) => value - reference[axis]);
    const action = this.step.act([angle, ...this.tracked].map(Math.fround));
    const within = (value, low, high) => clip(low + ((value + 1) / 2) * (high - low), low, high);
    return {
      angle: within(action[0], limits.angle_min_rad, limits.angle_max_rad),
      velocity: within(action[1], limits.velocity_min_rad_s, limits.velocity_max_rad_s),
    };
  }
}
