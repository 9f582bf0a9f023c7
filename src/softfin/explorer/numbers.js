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

/* A finite number of half precision. */
function halfNumber(bits) {
  const exponent = (bits >> 10) & 31, fraction = bits & 1023, size = exponent ? 2 ** (exponent - 25) * (1024 + fraction) : 2 ** -24 * fraction;
  return bits >> 15 ? -size : size;
}

/* {shape, data}, with base64 of little-endian float32 or float16, as {shape, values}. */
function decoded({ shape, data }) {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0)), count = shape.reduce((a, b) => a * b, 1);
  const values = bytes.length === 2 * count ? Float64Array.from(new Uint16Array(bytes.buffer), halfNumber) : Float64Array.from(new Float32Array(bytes.buffer));
  return { shape, values };
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

/* Solution of matrix @ unknown = right, by elimination with the largest pivot of each column, and the logarithm of the
 * absolute determinant of the matrix; matrices are lists of rows. */
function solved(matrix, right) {
  const n = matrix.length, a = matrix.map((row) => Float64Array.from(row)), b = right.map((row) => Float64Array.from(row));
  const subtract = (row, factor, from) => { for (let j = 0; j < row.length; j++) from[j] -= factor * row[j]; };
  for (let k = 0; k < n; k++) {
    let pivot = k;
    for (let i = k + 1; i < n; i++) if (Math.abs(a[i][k]) > Math.abs(a[pivot][k])) pivot = i;
    [a[k], a[pivot], b[k], b[pivot]] = [a[pivot], a[k], b[pivot], b[k]];
    for (let i = k + 1; i < n; i++) {
      const factor = a[i][k] / a[k][k];
      subtract(a[k], factor, a[i]);
      subtract(b[k], factor, b[i]);
    }
  }
  for (let k = n - 1; k >= 0; k--) {
    for (let i = k + 1; i < n; i++) subtract(b[i], a[k][i], b[k]);
    for (let j = 0; j < b[k].length; j++) b[k][j] /= a[k][k];
  }
  return { solution: b, logDeterminant: a.reduce((sum, row, k) => sum + Math.log(Math.abs(row[k])), 0) };
}
