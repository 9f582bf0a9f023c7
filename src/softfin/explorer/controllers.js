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

const CONTROLLERS = { gaits: GaitController, single: SingleController, grid: GridController };

/* A controller of any kind, at rest, with optional feedback. */
class Controller {
  constructor(description) {
    // `tracked` is the corrected reference of the last action, `added` the correction; null before the first action.
    Object.assign(this, { description, limits: description.limits, cells: description.cells, feedback: null, tracked: null, added: null });
    this.step = new CONTROLLERS[description.kind](description);
    this.reachable = description.reachable === null ? null : new Reachable(description.reachable);
  }

  /* Start feedback from the measurements `uses`, or stop it ("none"), before an action, which is numbered from the start
   * of the clock. */
  useFeedback(uses, action) {
    this.feedback = uses === "none" ? null : new Feedback(this.description.feedback, this.cells, this.reachable, uses, action);
  }

  /* The command for a reference [N], from the latest angle [rad], and the mean force [N], torques [N m] and powers [W]
   * since the last action. */
  act(measured, reference) {
    const { limits } = this;
    this.tracked = this.feedback === null ? reference : this.feedback.correct(measured, reference);
    this.added = this.tracked.map((value, axis) => value - reference[axis]);
    const action = this.step.act([measured.angle, ...this.tracked].map(Math.fround));
    const within = (value, low, high) => clip(low + ((value + 1) / 2) * (high - low), low, high);
    return {
      angle: within(action[0], limits.angle_min_rad, limits.angle_max_rad),
      velocity: within(action[1], limits.velocity_min_rad_s, limits.velocity_max_rad_s),
    };
  }
}
