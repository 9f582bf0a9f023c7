/* The trapezoidal profile that a positioning drive follows (softfin.tank.drive). A command is {angle, velocity}. */

/* The fastest velocity from which the profile, in steps of time, stops at the target without overshoot. */
function nextVelocity(angle, velocity, command, acceleration, seconds) {
  const ahead = command.angle - angle - (seconds * velocity) / 2, gain = acceleration * seconds;
  const braking = Math.sqrt((gain / 2) ** 2 + 2 * acceleration * Math.abs(ahead)) - gain / 2;
  const speed = Math.min(braking, Math.abs(ahead) / seconds, command.velocity);
  return velocity + clip(Math.sign(ahead) * speed - velocity, -gain, gain);
}

/* The command of `delay` ticks ago among the last ones, newest first; between whole ticks, a mean of two. */
function delayed(commands, delay) {
  const obeyed = { angle: 0, velocity: 0 };
  commands.forEach((command, age) => {
    const weight = Math.max(1 - Math.abs(age - delay), 0);
    obeyed.angle += weight * command.angle;
    obeyed.velocity += weight * command.velocity;
  });
  return obeyed;
}
