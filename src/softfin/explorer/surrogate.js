/* The streaming surrogate, tick by tick (softfin.surrogate.streaming): an ensemble of drive and force networks. */

const PROFILE_STEPS = 2;

const magnitudes = (values) => values.map((x) => Math.sqrt(1 + x * x) - 1);

/* Components along (cos, -sin) and across (sin, cos) of an angle, in the axes that the angle is counted from. */
function turnedBy(along, across, angle) {
  const cos = Math.cos(angle), sin = Math.sin(angle);
  return [along * cos + across * sin, across * cos - along * sin];
}

/* A gated recurrent unit that mirrors inputs to outputs exactly; `pick` finds its weights by name. */
class MirrorCore {
  constructor(pick) {
    for (const name of ["odd_in", "even_in", "bias", "hidden_in", "hidden_bias", "even_out", "odd_out", "odd_factors"]) this[name] = pick(name);
    [this.units, this.odd_outputs] = this.odd_out.shape;
  }

  /* Step the memory {even, odd} by a tick, in place; returns the outputs {even, odd}. */
  step(memory, even, odd) {
    const n = this.units, mixed = product(joined(memory.odd, odd), this.odd_in);
    const sizes = magnitudes(mixed.subarray(n));
    const gates = product(joined(memory.even, even, sizes), this.even_in, this.bias);
    for (let i = 0; i < n; i++) {
      memory.even[i] += sigmoid(gates[i]) * (Math.tanh(gates[2 * n + i]) - memory.even[i]);
      memory.odd[i] += sigmoid(gates[n + i]) * (Math.tanh(mixed[i] * gates[3 * n + i]) - memory.odd[i]);
    }
    const hidden = product(joined(memory.even, sizes), this.hidden_in, this.hidden_bias).map(Math.tanh);
    const factors = product(hidden, this.odd_factors), outputs = new Float64Array(this.odd_outputs);
    for (let k = 0; k < this.odd_outputs; k++) {
      for (let i = 0; i < n; i++) outputs[k] += (this.odd_out.values[i * this.odd_outputs + k] + factors[k * n + i]) * memory.odd[i];
    }
    return { even: product(hidden, this.even_out), odd: outputs };
  }
}

/* The drive network: commands in, the shaft's motion out. */
class FollowingNet {
  constructor(pick, scales, rest) {
    this.core = new MirrorCore((name) => pick(`core.${name}`));
    this.coefficients = {};
    for (const name of ["gain", "zero", "delay", "velocity_factor", "velocity_limit", "acceleration", "lag"]) this.coefficients[name] = pick(`profile.${name}`).values[0];
    this.scales = scales;
    this.angle = rest("profile.motion.angle")[0];
    this.velocity = rest("profile.motion.velocity")[0];
    const velocities = rest("profile.waiting.velocity");
    this.waiting = Array.from(rest("profile.waiting.angle"), (angle, i) => ({ angle, velocity: velocities[i] }));
    this.memory = { even: rest("memory.even"), odd: rest("memory.odd") };
  }

  /* Step by a tick under a command; returns the motion {angle, velocity} that the shaft has come to. */
  step(command) {
    const { coefficients: c, scales } = this, before = this.velocity;
    this.waiting.unshift(command);
    const obeyed = delayed(this.waiting, c.delay), seconds = TICK_S / PROFILE_STEPS;
    this.waiting.pop();
    const target = { angle: c.gain * obeyed.angle + c.zero, velocity: Math.min(c.velocity_factor * obeyed.velocity, c.velocity_limit) };
    for (let k = 0; k < PROFILE_STEPS; k++) {
      const after = nextVelocity(this.angle, this.velocity, target, c.acceleration, seconds);
      this.angle += (seconds * (this.velocity + after)) / 2;
      this.velocity = after;
    }
    const angle = this.angle - c.lag * this.velocity;
    const odd = [(target.angle - angle) / scales.angle_rad, this.velocity / scales.velocity_rad_s, (this.velocity - before) / scales.change_rad_s];
    const outputs = this.core.step(this.memory, [target.velocity / scales.velocity_rad_s], odd);
    return { angle: angle + TICK_S * scales.velocity_rad_s * outputs.odd[0], velocity: this.velocity + scales.change_rad_s * outputs.odd[1] };
  }
}

/* The force network: motion in, force (x, y) [N] and torque on the fin [N m] out; the torque is NaN without its coefficients. */
class ForceNet {
  constructor(pick, scales, rest) {
    this.core = new MirrorCore((name) => pick(`core.${name}`));
    this.along = pick("along");
    this.across = pick("across");
    this.kept = pick("log_time").values.map((time) => Math.exp(-TICK_S * Math.exp(-time)));
    for (const name of ["thrust", "resistance", "mount_turn", "offset"]) this[name] = pick(name).values;
    this.torque = pick("torque")?.values;
    this.scales = scales;
    this.memory = { even: rest("memory.even"), odd: rest("memory.odd") };
    this.wake = { even: rest("wake.even"), odd: rest("wake.odd") };
    this.motion = { angle: rest("motion.angle")[0], velocity: rest("motion.velocity")[0] };
  }

  step(motion) {
    const { wake, scales } = this, turn = this.motion.angle - motion.angle;
    for (let k = 0; k < wake.even.length; k++) [wake.even[k], wake.odd[k]] = turnedBy(wake.even[k], wake.odd[k], turn);
    const velocity = motion.velocity / scales.velocity_rad_s, change = (motion.velocity - this.motion.velocity) / scales.change_rad_s;
    const drag = velocity * Math.abs(velocity);
    const outputs = this.core.step(this.memory, wake.even, joined([velocity, change, drag], wake.odd));
    const along = outputs.even[0] + dot(this.thrust, [velocity ** 2, velocity * change]);
    const across = outputs.odd[0] + dot(this.resistance, [change, drag, velocity]);
    const force = turnedBy(along, across, this.mount_turn[0] + motion.angle);
    const pushed = { even: product(this.memory.even, this.along), odd: product(this.memory.odd, this.across) };
    for (const parity of ["even", "odd"]) {
      for (let k = 0; k < wake.even.length; k++) wake[parity][k] = this.kept[k] * wake[parity][k] + (1 - this.kept[k]) * pushed[parity][k];
    }
    this.motion = motion;
    return {
      force: force.map((value, axis) => scales.force_n * (value + this.offset[axis])),
      torque: this.torque ? dot(this.torque, joined(this.memory.odd, wake.odd, [velocity, change, drag])) : NaN,
    };
  }

  remembered() {
    return joined(this.memory.even, this.memory.odd, this.wake.even, this.wake.odd);
  }
}

/* An ensemble, long at rest. */
class StreamingSurrogate {
  constructor(description) {
    const arrays = Object.fromEntries(Object.entries(description.arrays).map(([name, array]) => [name, decoded(array)]));
    this.interval = description.interval;
    this.mean = arrays["familiarity.mean"].values;
    this.whitening = arrays["familiarity.whitening"];
    this.members = Array.from({ length: description.members }, (_, index) => {
      const net = (Net, name) => new Net(
        (place) => arrays[`members.${name}.${place}`] && part(arrays[`members.${name}.${place}`], index), description.scales,
        (place) => part(arrays[`rest.${name}.${place}`], index).values.slice());
      return { drive: net(FollowingNet, "drive"), force: net(ForceNet, "force") };
    });
    this.power = this.members[0].force.torque ? "mechanical" : "";
  }

  /* Hold a command for a tick; returns {angle, velocity, force, torque} and the force of every member, `forces`. */
  tick(command) {
    const readings = this.members.map((member) => {
      const motion = member.drive.step(command);
      return { ...motion, ...member.force.step(motion) };
    });
    const mean = (of) => readings.reduce((sum, reading) => sum + of(reading), 0) / readings.length;
    return {
      angle: mean((r) => r.angle), velocity: mean((r) => r.velocity), force: [mean((r) => r.force[0]), mean((r) => r.force[1])],
      torque: mean((r) => r.torque), forces: readings.map((r) => r.force),
    };
  }

  /* Distance of the last motion from the training data: 1 is as far as one in a thousand moments of them. */
  distance() {
    const memory = this.members[0].force.remembered();
    return Math.hypot(...product(memory.map((value, i) => value - this.mean[i]), this.whitening));
  }

  /* Half width [N] of the interval on one axis of the mean force, from the members' own means. */
  halfWidth(means) {
    const mean = means.reduce((a, b) => a + b, 0) / means.length;
    const variance = means.reduce((sum, value) => sum + (value - mean) ** 2, 0) / means.length;
    return this.interval.factor * Math.sqrt(variance + this.interval.floor_n ** 2);
  }
}
