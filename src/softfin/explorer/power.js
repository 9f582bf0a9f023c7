/* Power of a drive (softfin.core.power). */

/* Mechanical power on the fin and electrical power of the motor [W], for mean torques over a tick [N m] at the
 * velocities before and after it [rad/s]; NaN if unknown. */
function drivePower({ torque, motorTorque = NaN, velocity }, before, motor = {}) {
  const { torque_constant_nm_a: constant, winding_ohm: resistance, gear_efficiency: efficiency } = motor, rate = (before + velocity) / 2;
  const loss = torque * (torque * rate > 0 ? 1 / efficiency : efficiency) - torque, current = (motorTorque + loss) / constant;
  return [torque * rate, Math.max(current * (resistance * current + constant * rate), 0)];
}
