/* Arrays as the page holds them, and the few products that the networks need. All numbers are of double precision;
 * weights were rounded to single precision when they were written. */

const TICK_S = 0.01;
/* Samples of the mean forces for which a surrogate's interval is calibrated. */
const INTERVAL_WINDOW = 200;
/* The clock of the page's controllers; the paper's until they are known. */
let ACTION_TICKS, WINDOW_ACTIONS, WINDOW, ACTION_RATE_HZ;

function useClock({ ticks, window_actions }) {
  const cycle = ticks.reduce((sum, each) => sum + each, 0);
  [ACTION_TICKS, WINDOW_ACTIONS] = [ticks, window_actions];
  WINDOW = (cycle * window_actions) / ticks.length;
  ACTION_RATE_HZ = ticks.length / (cycle * TICK_S);
}

useClock({ ticks: [33, 33, 34], window_actions: 6 });

/* {shape, data}, with base64 of little-endian float32, as {shape, values}. */
function decoded({ shape, data }) {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  return { shape, values: Float64Array.from(new Float32Array(bytes.buffer)) };
}

/* Part `index` along the first axis. */
function part({ shape, values }, index) {
  const size = shape.slice(1).reduce((a, b) => a * b, 1);
  return { shape: shape.slice(1), values: values.subarray(index * size, (index + 1) * size) };
}

/* Product of a vector and a matrix (rows, columns), added to a bias where there is one. */
function product(vector, { shape, values }, bias = null) {
  const columns = shape[1], sums = bias === null ? new Float64Array(columns) : Float64Array.from(bias.values);
  for (let i = 0; i < vector.length; i++) {
    const factor = vector[i], row = i * columns;
    for (let j = 0; j < columns; j++) sums[j] += factor * values[row + j];
  }
  return sums;
}

const clip = (value, low, high) => Math.min(Math.max(value, low), high);
const dot = (a, b) => { let sum = 0; for (let i = 0; i < a.length; i++) sum += a[i] * b[i]; return sum; };
const joined = (...series) => [].concat(...series.map((each) => Array.from(each)));
const sigmoid = (x) => 1 / (1 + Math.exp(-x));
