/* The user's hand in place of a controller: one stroke per action to both sides of an angle; a stroke of 0 holds it. */

class Hand {
  constructor(description) {
    Object.assign(this, { description, cells: [], reachable: null, feedback: null, tracked: null, added: null, side: -1 });
    Object.assign(this, description.first);
  }

  /* Motion by hand has no target that feedback could correct. */
  useFeedback() {}

  act() {
    const { angle_min_rad, angle_max_rad } = this.description.limits;
    this.side = -this.side;
    return { angle: clip(this.angle + this.side * this.stroke, angle_min_rad, angle_max_rad), velocity: this.velocity };
  }
}

/* Greatest force in two seconds of the hand's first motion [N]. */
function peakForce(plant, description) {
  const loop = new Loop({ plant }, "plant", new Hand(description), [0, 0]);
  let peak = 0;
  for (let k = 0; k < 200; k++) peak = Math.max(peak, Math.hypot(...loop.tick().force));
  return peak;
}
