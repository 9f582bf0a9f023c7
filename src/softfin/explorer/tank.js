/* The virtual tank, tick by tick (softfin.tank): drive, soft fin as a chain of plates, water, and the force sensor
 * without its noise, drift and resolution. Series hold a number for each plate. */

const GAUSS = [0.5 - 0.5 / Math.sqrt(3), 0.5 + 0.5 / Math.sqrt(3)];
const REFERENCE_STROKE = 5, LEAST_STROKE = 0.5, SLOWEST_FRICTION_M_S = 0.01, SHORTEST_S = 1e-6;

const zeros = (count) => new Float64Array(count);
const remaining = (time) => Math.exp(-TICK_S / Math.max(time, SHORTEST_S));
const each = (count, value) => Float64Array.from({ length: count }, (_, i) => value(i));

/* How the turning of plate j moves the inner end of plate i > j, in rows of all plates [m]. */
function poseOf(angles, length) {
  const n = angles.length, normal = zeros(n * n), along = zeros(n * n);
  for (let i = 0; i < n; i++) {
    for (let j = 0; j < i; j++) {
      normal[i * n + j] = length * Math.cos(angles[i] - angles[j]);
      along[i * n + j] = length * Math.sin(angles[i] - angles[j]);
    }
  }
  return { normal, along };
}

function timesRow(matrix, i, series) {
  let sum = 0;
  for (let j = 0, n = series.length; j < n; j++) sum += matrix[i * n + j] * series[j];
  return sum;
}

/* Motion of plates that turn at absolute rates: velocity of the inner end along n and d, and the rates. */
function motionOf(pose, rates) {
  const n = rates.length;
  return { normal: each(n, (i) => timesRow(pose.normal, i, rates)), along: each(n, (i) => timesRow(pose.along, i, rates)), turning: rates };
}

/* One velocity (x, y) along every plate's axes. */
function componentsOf(angles, [x, y]) {
  return {
    normal: angles.map((angle) => x * Math.sin(angle) + y * Math.cos(angle)),
    along: angles.map((angle) => y * Math.sin(angle) - x * Math.cos(angle)), turning: zeros(angles.length),
  };
}

function difference(one, other) {
  const less = (a, b) => a.map((value, i) => value - b[i]);
  return { normal: less(one.normal, other.normal), along: less(one.along, other.along), turning: less(one.turning, other.turning) };
}

/* Momentum of a motion, or the force that resists it, by moments of mass or of drag. */
function wrenchOf(moments, motion) {
  const n = motion.normal.length;
  return {
    normal: each(n, (i) => moments.zeroth[i] * motion.normal[i] + moments.first[i] * motion.turning[i]),
    along: each(n, (i) => moments.along[i] * motion.along[i]),
    moment: each(n, (i) => moments.first[i] * motion.normal[i] + moments.second[i] * motion.turning[i]),
  };
}

/* Minus the rate of change of each plate's momentum at constant rates of turning. */
function centripetal(pose, inertia, motion) {
  const n = motion.normal.length, squares = motion.turning.map((rate) => rate * rate), momentum = wrenchOf(inertia, motion);
  const normal = zeros(n), along = zeros(n), moment = zeros(n);
  for (let i = 0; i < n; i++) {
    const turning = motion.turning[i];
    const rise = timesRow(pose.along, i, squares) - motion.along[i] * turning;
    const slide = motion.normal[i] * turning - timesRow(pose.normal, i, squares);
    normal[i] = -inertia.zeroth[i] * rise - turning * momentum.along[i];
    along[i] = -inertia.along[i] * slide + turning * momentum.normal[i];
    moment[i] = -inertia.first[i] * rise - motion.along[i] * momentum.normal[i] + motion.normal[i] * momentum.along[i];
  }
  return { normal, along, moment };
}

/* Sum of the forces in the axes of the tank. */
function resultant(angles, wrench) {
  let x = 0, y = 0;
  angles.forEach((angle, i) => {
    const sin = Math.sin(angle), cos = Math.cos(angle);
    x += wrench.normal[i] * sin - wrench.along[i] * cos;
    y += wrench.normal[i] * cos + wrench.along[i] * sin;
  });
  return [x, y];
}

/* Matrix from rates of turning to generalised momenta, in rows. */
function chainMatrix(pose, moments) {
  const n = moments.zeroth.length, matrix = zeros(n * n);
  for (let j = 0; j < n; j++) {
    for (let k = 0; k < n; k++) {
      let sum = moments.first[j] * pose.normal[j * n + k] + moments.first[k] * pose.normal[k * n + j];
      for (let i = Math.max(j, k) + 1; i < n; i++) {
        sum += pose.normal[i * n + j] * moments.zeroth[i] * pose.normal[i * n + k] + pose.along[i * n + j] * moments.along[i] * pose.along[i * n + k];
      }
      matrix[j * n + k] = sum + (j === k ? moments.second[j] : 0);
    }
  }
  return matrix;
}

/* Eliminate all plates but the first from the symmetric system matrix @ rates = right, from the tip inwards; returns
 * inertia and impulse of the first plate, and the rates of all from its rate. */
function condensed(matrix, right) {
  const n = right.length, a = Float64Array.from(matrix), b = Float64Array.from(right);
  for (let k = n - 1; k > 0; k--) {
    for (let i = 0; i < k; i++) {
      const factor = a[i * n + k] / a[k * n + k];
      for (let j = 0; j < k; j++) a[i * n + j] -= factor * a[k * n + j];
      b[i] -= factor * b[k];
    }
  }
  const expand = (first) => {
    const rates = zeros(n);
    rates[0] = first;
    for (let i = 1; i < n; i++) {
      let rest = b[i];
      for (let j = 0; j < i; j++) rest -= a[i * n + j] * rates[j];
      rates[i] = rest / a[i * n + i];
    }
    return rates;
  };
  return { inertia: a[0], impulse: b[0], expand };
}

class Drive {
  constructor(parameters, angle) {
    Object.assign(this, parameters);
    Object.assign(this, { profileAngle: angle, profileVelocity: 0, angle, rate: 0 });
    this.waiting = Array.from({ length: parameters.dead_ticks }, () => ({ angle, velocity: 0 }));
  }

  receive(command) {
    this.waiting.unshift(command);
    const obeyed = delayed(this.waiting, this.dead_time / TICK_S);
    this.waiting.pop();
    return obeyed;
  }

  /* Begin a step of time: the profile moves on, and the motor's mean torque becomes pull - grip * (mean rate). */
  plan(command, seconds) {
    const velocity = nextVelocity(this.profileAngle, this.profileVelocity, command, this.acceleration, seconds);
    const angle = this.profileAngle + (seconds * (velocity + this.profileVelocity)) / 2, half = seconds / 2;
    const damping = 2 * Math.sqrt(this.stiffness * this.inertia);
    this.pull = this.stiffness * ((this.profileAngle + angle) / 2 - this.angle) + (damping * (this.profileVelocity + velocity)) / 2;
    this.grip = this.stiffness * (this.lag + half) + damping;
    this.rotor = this.inertia / half;
    [this.profileAngle, this.profileVelocity] = [angle, velocity];
  }

  /* The shaft's mean rate where the fin exerts load - drag * rate on it. */
  turn(load, drag) {
    const free = (this.rotor * this.rate + this.pull + load) / (this.rotor + this.grip + drag), torque = this.pull - this.grip * free;
    const limited = clip(torque, -this.torque_limit, this.torque_limit);
    return limited === torque ? free : (this.rotor * this.rate + limited + load) / (this.rotor + drag);
  }

  /* End a step in which the motor turned at this mean rate; returns the mean torque of the motor [N m]. */
  follow(mean, seconds) {
    this.angle += seconds * mean;
    this.rate = 2 * mean - this.rate;
    return clip(this.pull - this.grip * mean, -this.torque_limit, this.torque_limit);
  }

  read() {
    const step = this.encoder_step;
    return { angle: step > 0 ? Math.round(this.angle / step) * step : this.angle, velocity: this.rate };
  }
}

class Fin {
  constructor(parameters, angle) {
    Object.assign(this, parameters);
    const n = this.plates = parameters.stiffness.length;
    Object.assign(this, { angles: Array(n).fill(angle), rates: zeros(n), accelerations: zeros(n), earlier: zeros(n) });
  }

  /* The shaft and the outer end of each plate [m]. */
  shape() {
    const points = [[0, 0]];
    for (const angle of this.angles) {
      const [x, y] = points[points.length - 1];
      points.push([x - this.plate_length * Math.cos(angle), y + this.plate_length * Math.sin(angle)]);
    }
    return points;
  }

  motion() {
    return motionOf(poseOf(this.angles, this.plate_length), this.rates);
  }

  relative(stream) {
    return difference(this.motion(), componentsOf(this.angles, stream));
  }

  /* Momentum of the fin and of the water that it carries [N s]. */
  momentum(water, stream) {
    const [x, y] = resultant(this.angles, wrenchOf(this.inertia, this.motion()));
    const [a, b] = resultant(this.angles, wrenchOf(water.inertia, this.relative(stream)));
    return [x + a, y + b];
  }

  /* Take one step of time on the drive's shaft; returns the shaft's mean rate and the loads' mean force [N]. */
  step(drive, water, stream, drags, factor, seconds) {
    const n = this.plates, half = seconds / 2, { stiffness, damping } = this;
    const predicted = each(n, (i) => this.rates[i] + (half * (this.accelerations[i] + this.earlier[i])) / 2);
    const angles = each(n, (i) => this.angles[i] + (half * (this.rates[i] + predicted[i])) / 2);
    const pose = poseOf(angles, this.plate_length), flow = componentsOf(angles, stream);
    const motion = motionOf(pose, predicted), relative = difference(motion, flow);
    const { resistance, suction } = water.loads(relative, drags);
    const push = wrenchOf(resistance, flow);
    push.along = push.along.map((value, i) => value + suction[i]);
    const sum = (name) => each(n, (i) => this.inertia[name][i] + water.inertia[name][i]);
    const inertia = { zeroth: sum("zeroth"), first: sum("first"), second: sum("second"), along: sum("along") };
    const momentum = wrenchOf(inertia, motionOf(pose, this.rates));
    const own = centripetal(pose, this.inertia, motion), carried = centripetal(pose, water.inertia, relative);
    const impulse = (name) => each(n, (i) => momentum[name][i] + half * (own[name][i] + carried[name][i] + push[name][i]));
    const wrench = { normal: impulse("normal"), along: impulse("along"), moment: impulse("moment") };
    const held = (name) => each(n, (i) => inertia[name][i] + half * resistance[name][i]);
    const matrix = chainMatrix(pose, { zeroth: held("zeroth"), first: held("first"), second: held("second"), along: held("along") });
    const grips = each(n, (i) => half * factor * (damping[i] + half * stiffness[i]));
    const strains = each(n, (i) => half * factor * stiffness[i] * (this.angles[i] - (i ? this.angles[i - 1] : drive.angle)));
    const right = wrench.moment;
    for (let i = 0; i < n; i++) {
      for (let j = 0; j < i; j++) right[j] += pose.normal[i * n + j] * wrench.normal[i] + pose.along[i * n + j] * wrench.along[i];
    }
    for (let i = 1; i < n; i++) {
      right[i] -= strains[i];
      right[i - 1] += strains[i];
      matrix[i * n + i] += grips[i];
      matrix[(i - 1) * (n + 1)] += grips[i];
      matrix[i * n + i - 1] -= grips[i];
      matrix[(i - 1) * n + i] -= grips[i];
    }
    const root = condensed(matrix, right);
    const { first, rate } = heldBy(root, drive, factor * stiffness[0], grips[0], this.angles[0] - drive.angle, half);
    const mean = root.expand(first), resisted = wrenchOf(resistance, motionOf(pose, mean));
    const force = resultant(angles, { normal: push.normal.map((f, i) => f - resisted.normal[i]), along: push.along.map((f, i) => f - resisted.along[i]) });
    this.earlier = this.accelerations;
    this.accelerations = each(n, (i) => (mean[i] - this.rates[i]) / half);
    this.angles = each(n, (i) => this.angles[i] + seconds * mean[i]);
    this.rates = each(n, (i) => 2 * mean[i] - this.rates[i]);
    return { rate, force };
  }
}

/* Mean rates over a step, of the first plate and of the shaft, with a joint between them that may have play. */
function heldBy({ inertia, impulse }, drive, stiffness, grip, bend, half) {
  const rates = (strain, tight) => {
    const total = inertia + tight, load = (strain * inertia + tight * impulse) / total, drag = (tight * inertia) / total;
    const rate = drive.turn(load / half, drag / half);
    return { first: (impulse - strain + tight * rate) / total, rate };
  };
  const loose = rates(0, 0), edge = drive.backlash / 2, middle = bend + half * (loose.first - loose.rate);
  if (middle <= -edge) return rates(half * stiffness * (bend + edge), grip);
  return middle >= edge ? rates(half * stiffness * (bend - edge), grip) : loose;
}

class Water {
  constructor(parameters) {
    Object.assign(this, parameters);
  }

  /* Drag at the two points of each plate, for the recent strokes, times a factor. */
  drags(flow, factor) {
    return this.drag.map((row) => row.map((value, i) => {
      const number = Math.sqrt((8 * Math.PI ** 2 * flow.square[i]) / this.span[i] ** 2 + LEAST_STROKE ** 2) / REFERENCE_STROKE;
      return factor * value * number ** -this.drag_exponent;
    }));
  }

  /* Resistance to the motion relative to the stream [kg/s], and the suction along the fin at its tip [N]. */
  loads(motion, drags) {
    const n = motion.normal.length, length = this.plate_length, places = GAUSS.map((place) => length * place);
    const resistance = { zeroth: zeros(n), first: zeros(n), second: zeros(n), along: zeros(n) }, suction = zeros(n);
    for (let i = 0; i < n; i++) {
      const leaving = this.tip[i] * Math.max(-motion.along[i], 0);
      const [a, b] = [0, 1].map((k) => ((drags[k][i] * length) / 2) * Math.abs(motion.normal[i] + places[k] * motion.turning[i]));
      resistance.zeroth[i] = a + b + leaving;
      resistance.first[i] = a * places[0] + b * places[1] + leaving * length;
      resistance.second[i] = a * places[0] ** 2 + b * places[1] ** 2 + leaving * length ** 2;
      resistance.along[i] = this.friction[i] * length * Math.sqrt(Math.sqrt(motion.along[i] ** 2 + SLOWEST_FRICTION_M_S ** 2));
      suction[i] = -0.5 * this.tip[i] * (motion.normal[i] + length * motion.turning[i]) ** 2;
    }
    return { resistance, suction };
  }

  /* Stir the flow by a tick in which the plates moved so relative to it, under the mean force of its loads [N]. */
  stir(flow, motion, force) {
    const kept = remaining(this.stream_decay), share = remaining(this.wake_memory);
    flow.stream = flow.stream.map((value, axis) => kept * value - (((1 - kept) * this.stream_decay) / this.stream_mass) * force[axis]);
    for (let i = 0; i < flow.excursion.length; i++) {
      flow.excursion[i] = share * flow.excursion[i] + TICK_S * (motion.normal[i] + (this.plate_length / 2) * motion.turning[i]);
      flow.square[i] = share * flow.square[i] + (1 - share) * flow.excursion[i] ** 2;
    }
  }
}

/* A tank with its fin at rest. The factors of stiffness and drag may change at any time. */
class Tank {
  constructor(description) {
    this.description = description;
    this.power = "electrical";
    this.motor = description.motor;
    this.drive = new Drive(description.drive, description.rest_rad);
    this.fin = new Fin(description.fin, description.rest_rad);
    this.water = new Water(description.water);
    this.flow = { stream: [0, 0], excursion: zeros(this.fin.plates), square: zeros(this.fin.plates) };
    this.filtered = [0, 0];
    this.stiffness = 1;
    this.drag = 1;
  }

  shape() {
    return this.fin.shape();
  }

  /* Have the water round the fin stream at a velocity (x, y) [m/s], which dies down as the fin's own stream does. */
  push(velocity) {
    this.flow.stream = [...velocity];
  }

  /* Hold a command for a tick; returns {angle, velocity, force, torque, motorTorque}, with the torque on the fin about the shaft
   * and the torque of the motor. A torque has the sign of the velocity if the drive delivers power. */
  tick(command) {
    const steps = this.description.steps_per_tick, seconds = TICK_S / steps, { drive, fin, water, flow, filtered } = this;
    const drags = water.drags(flow, this.drag), stream = flow.stream, shaftRate = drive.rate;
    const obeyed = drive.receive(command), before = fin.momentum(water, stream), loads = [0, 0];
    let motorTorque = 0;
    for (let k = 0; k < steps; k++) {
      drive.plan(obeyed, seconds);
      const { rate, force } = fin.step(drive, water, stream, drags, this.stiffness, seconds);
      motorTorque += drive.follow(rate, seconds) / steps;
      force.forEach((value, axis) => { loads[axis] += value / steps; });
    }
    const after = fin.momentum(water, stream), { filter_time, misalignment, range } = this.description.sensor;
    this.filtered = filtered.map((value, axis) => {
      const force = loads[axis] - (after[axis] - before[axis]) / TICK_S;
      return force + (value - force) * remaining(filter_time);
    });
    const [x, y] = this.filtered, cos = Math.cos(misalignment), sin = Math.sin(misalignment), most = range > 0 ? range : Infinity;
    water.stir(flow, fin.relative(stream), loads);
    // The part of the torque that accelerates the rotor does not reach the fin.
    const torque = motorTorque - (drive.inertia * (drive.rate - shaftRate)) / TICK_S;
    return { ...drive.read(), torque, motorTorque, force: [clip(cos * x + sin * y, -most, most), clip(cos * y - sin * x, -most, most)] };
  }
}
