/* The closed loop: a controller acts on a plant on its own clock; what is measured is kept for a while. */

const KEPT = 1000;
/* Means at the start of an action. */
const NOTHING = { force: [0, 0], shaft: [0, 0], motor: [0, 0] };

/* The last `length` pairs, and the sums by which means and the Sobolev term of a window are computed. */
class MovingWindow {
  constructor(length) {
    [this.length, this.pairs, this.next] = [length, [], 0];
  }

  push(pair) {
    this.pairs[this.next] = pair;
    this.next = (this.next + 1) % this.length;
  }

  /* Oldest first. */
  series() {
    return this.pairs.length < this.length ? this.pairs : [...this.pairs.slice(this.next), ...this.pairs.slice(0, this.next)];
  }

  mean() {
    const count = Math.max(this.pairs.length, 1);
    return [0, 1].map((axis) => this.pairs.reduce((sum, pair) => sum + pair[axis], 0) / count);
  }

  /* Root of the mean square by which consecutive forces differ, on either axis [N]. */
  sobolev() {
    const series = this.series();
    return [0, 1].map((axis) => {
      let square = 0;
      for (let i = 1; i < series.length; i++) square += (series[i][axis] - series[i - 1][axis]) ** 2;
      return Math.sqrt(square / Math.max(series.length - 1, 1));
    });
  }
}

/* Plants by name under the commands of one controller; all move, one of them is measured. */
class Loop {
  constructor(plants, plant, controller, reference) {
    Object.assign(this, { plants, plant, reference, time: 0 });
    this.averages = Object.fromEntries(Object.keys(plants).map((name) => [name, new MovingWindow(WINDOW)]));
    // Mechanical and electrical power [W].
    this.powers = Object.fromEntries(Object.keys(plants).map((name) => [name, new MovingWindow(WINDOW)]));
    this.memberAverages = Object.fromEntries(Object.entries(plants).map(([name, each]) => [name, (each.members || []).map(() => new MovingWindow(INTERVAL_WINDOW))]));
    // Of the last window, for the plants that know their distance from their training data.
    this.distances = Object.fromEntries(Object.entries(plants).filter(([, each]) => each.distance).map(([name]) => [name, []]));
    this.readings = {};
    this.history = [];
    this.change(controller);
  }

  /* Let another controller act from now on, as from rest, at the start of the clock. */
  change(controller) {
    Object.assign(this, { controller, action: 0, left: 0, means: NOTHING, command: { angle: 0, velocity: 1 } });
  }

  /* The target force; a hand has none, and a canvas does not draw what is not a number. */
  target() {
    return this.controller instanceof Hand ? [NaN, NaN] : this.reference;
  }

  tick() {
    if (this.left === 0) {
      const reading = this.readings[this.plant], measured = { ...this.means, angle: reading ? reading.angle : this.controller.description.rest_rad };
      this.command = this.controller.act(measured, this.reference);
      [this.left, this.means] = [ACTION_TICKS[this.action % ACTION_TICKS.length], NOTHING];
      this.action++;
    }
    for (const [name, plant] of Object.entries(this.plants)) {
      const reading = plant.tick(this.command), { velocity } = this.readings[name] ?? reading;
      this.readings[name] = reading;
      this.powers[name].push(drivePower(reading, velocity, plant.motor));
      this.averages[name].push(reading.force);
      this.memberAverages[name].forEach((window, index) => window.push(reading.forces[index]));
      if (this.distances[name]) this.distances[name] = [...this.distances[name].slice(1 - WINDOW), plant.distance()];
    }
    this.left--;
    this.time++;
    const reading = this.readings[this.plant], force = reading.force;
    // Torques are means over a tick, so their power uses the mean velocity, within an action as in Python.
    const { torque = NaN, motorTorque = NaN } = reading, ticks = ACTION_TICKS[(this.action - 1) % ACTION_TICKS.length];
    const velocity = (reading.velocity + (this.left === ticks - 1 ? reading.velocity : this.velocity)) / 2;
    this.velocity = reading.velocity;
    const now = { force, shaft: [torque, torque * velocity], motor: [motorTorque, motorTorque * velocity] };
    this.means = Object.fromEntries(Object.entries(now).map(([name, pair]) => [name, pair.map((value, k) => this.means[name][k] + value / ticks)]));
    const plant = this.plants[this.plant], shape = plant.shape ? plant.shape() : null;
    this.history.push({ angle: reading.angle, command: this.command.angle, force, mean: this.mean(), reference: this.target(), shape });
    if (this.history.length > KEPT) this.history.splice(0, this.history.length - KEPT);
    return reading;
  }

  /* Mean force over the window [N]; NaN before the first window is full, which a canvas does not draw. */
  mean() {
    return this.time < WINDOW ? [NaN, NaN] : this.averages[this.plant].mean();
  }

  /* Mean power over the window [W], electrical if known, and otherwise mechanical; NaN like the mean force. */
  power() {
    const [mechanical, electrical] = this.time < WINDOW ? [NaN, NaN] : this.powers[this.plant].mean();
    return this.plants[this.plant].power === "electrical" ? electrical : mechanical;
  }

  /* |moving average - reference| on either axis [N]. */
  error() {
    return this.mean().map((value, axis) => Math.abs(value - this.reference[axis]));
  }
}
