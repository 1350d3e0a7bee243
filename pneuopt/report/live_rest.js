// The rest, or steady motion, from which a response begins where a slider moves it: damped Gauss-Newton steps from the
// design's, on the residuals that vanish there: rates, what a sample changes, and the measured signal's error.
const REST_DIFFERENCE = 1e-7; // of a state's nominal size: larger bends a column of the Jacobian, smaller rounds it
const REST_STEP = 1e-11; // of the same: a step below it changes no response
const REST_ROUNDING = 1e-8; // of the same: steps and residuals below it, which fall no more, are rounding
const REST_LIMIT = 1e9; // of the command, while it is sought: where it is clipped no residual shows the way back
const REST_STEPS = 60; // at most at one setting: twenty are usual where a valve's dead zone bends the residuals
const REST_HALVINGS = 12; // of a step that raises the residuals
const REST_PARTS = 32; // into which the way from the design to a setting may be cut

function restResiduals(loop, x, u, rest, reference) {
  const [dx, after] = [new Float64Array(x.length), new Float64Array(x.length)];
  const y = new Float64Array(LOOP.outputs.length);
  loop.rates(0, x, u, dx, y);
  if (LOOP.sampleTime) loop.update(0, x, u, after);
  const every = rest.rows.map((k) => (k < x.length ? dx[k] : after[k - x.length] - x[k - x.length]));
  return rest.holds ? [...every, y[DATA.measured] - reference.initial] : every;
}

// The least-squares solution of A z = b by Householder's reflections; the columns of A are its arrays.
function leastSquares(A, b) {
  const [n, m] = [A.length, b.length];
  const dot = (v, w, from) => v.reduce((sum, value, i) => (i < from ? sum : sum + value * w[i]), 0);
  const diagonal = A.map((column, k) => {
    const size = Math.sqrt(dot(column, column, k)) * (column[k] > 0 ? -1 : 1);
    const mirror = column.map((value, i) => (i < k ? 0 : i === k ? value - size : value));
    const square = dot(mirror, mirror, k);
    for (const other of square ? [...A.slice(k + 1), b] : []) {
      const share = (2 * dot(mirror, other, k)) / square;
      for (let i = k; i < m; i++) other[i] -= share * mirror[i];
    }
    return size;
  });
  const z = new Array(n).fill(0);
  for (let k = n - 1; k >= 0; k--) {
    let sum = b[k];
    for (let j = k + 1; j < n; j++) sum -= A[j][k] * z[j];
    z[k] = diagonal[k] ? sum / diagonal[k] : NaN;
  }
  return z;
}

// The loop before dither is switched on, and without the clip.
function makeRestingLoop(p) {
  const own = Float64Array.from(p);
  const values = { "pid.lower": -REST_LIMIT, "pid.upper": REST_LIMIT, "dither.amplitude": 0, "dither.offset": 0 };
  for (const [name, value] of Object.entries(values)) {
    const place = LOOP.parameters.indexOf(name);
    if (place >= 0) own[place] = value;
  }
  return makeLoop(own);
}

function keepsLimits(p, x, u) {
  const y = new Float64Array(LOOP.outputs.length);
  makeRestingLoop(p).rates(0, x, u, new Float64Array(x.length), y);
  const limit = (name) => p[LOOP.parameters.indexOf(name)]; // undefined, which nothing breaks, of a loop without limits
  const command = y[y.length - 1];
  return !(command < limit("pid.lower") || command > limit("pid.upper"));
}

function inputsBefore(reference) {
  const u = new Float64Array(LOOP.inputs.length);
  u[LOOP.inputs.indexOf("reference")] = reference.initial;
  return u;
}

function solveRest(p, begin, reference) {
  const { rest } = reference;
  const loop = makeRestingLoop(p);
  const u = inputsBefore(reference);
  const x = Float64Array.from(begin);
  let r = restResiduals(loop, x, u, rest, reference);
  for (let step = 0; step < REST_STEPS; step++) {
    const columns = rest.unknown.map((k) => {
      const [here, h] = [x[k], REST_DIFFERENCE * LOOP.nominal[k]];
      x[k] = here + h;
      const beside = restResiduals(loop, x, u, rest, reference);
      x[k] = here;
      return beside.map((value, i) => (value - r[i]) / REST_DIFFERENCE);
    });
    const weights = r.map((_, i) => 1 / (Math.max(...columns.map((column) => Math.abs(column[i]))) || 1));
    const weighed = (values) => values.map((value, i) => value * weights[i]);
    const size = (values) => Math.hypot(...weighed(values));
    const z = leastSquares(columns.map(weighed), weighed(r));
    const length = Math.max(...z.map(Math.abs));
    if (!Number.isFinite(length)) return null;
    let [share, next, tried] = [1, null, null];
    for (let halving = 0; halving <= REST_HALVINGS; halving++, share /= 2) {
      tried = Float64Array.from(x);
      rest.unknown.forEach((k, j) => (tried[k] -= share * z[j] * LOOP.nominal[k]));
      next = restResiduals(loop, tried, u, rest, reference);
      if (size(next) < size(r)) break;
      next = null;
    }
    if (!next) return Math.max(length, size(r)) < REST_ROUNDING ? x : null;
    x.set(tried);
    r = next;
    if (share * length < REST_STEP) return size(r) < REST_ROUNDING ? x : null;
  }
  return null;
}

// Null where none is found: the plant cannot rest or move so, or its command lies beyond its limits.
function findRest(p, reference) {
  const { rest, x0 } = reference;
  if (!rest || rest.places.every((k) => p[k] === DATA.values[k])) return Float64Array.from(x0);
  for (let parts = 1; parts <= REST_PARTS; parts *= 4) {
    let x = Float64Array.from(x0);
    for (let part = 1; x && part <= parts; part++) {
      const between = p.map((value, k) => (part === parts ? value : DATA.values[k] + ((value - DATA.values[k]) * part) / parts));
      x = solveRest(between, x, reference);
    }
    if (x) return keepsLimits(p, x, inputsBefore(reference)) ? x : null;
  }
  return null;
}
