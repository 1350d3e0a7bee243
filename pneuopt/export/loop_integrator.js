// Dormand and Prince's embedded Runge-Kutta formulas of orders 5 and 4 with step control:
// J. R. Dormand, P. J. Prince, A family of embedded Runge-Kutta formulae, J. Comp. Appl. Math. 6 (1980) 19-26.
const RELATIVE_TOLERANCE = 3e-10; // of a step's error: 3e-8 leaves 2e-5 where gains are high, 1e-11 costs twice the time of a frame
const ABSOLUTE_TOLERANCE = 3e-11; // of the same, as a share of each state's nominal size
const MOST_STEPS = 400000; // beyond: the loop is too stiff, or has left what its model describes

function makeStepper(loop) {
  const n = LOOP.states.length;
  const [k1, k2, k3, k4, k5, k6, k7, z] = Array.from({ length: 8 }, () => new Float64Array(n));
  const y = new Float64Array(LOOP.outputs.length);
  let usual = 1e-5; // of a step [s]: the first one, and what the last interval found right
  let steps = 0;

  function tryStep(t, h, x, u) {
    for (let i = 0; i < n; i++) z[i] = x[i] + (h / 5) * k1[i];
    loop.rates(t + h / 5, z, u, k2, y);
    for (let i = 0; i < n; i++) z[i] = x[i] + h * ((3 / 40) * k1[i] + (9 / 40) * k2[i]);
    loop.rates(t + 0.3 * h, z, u, k3, y);
    for (let i = 0; i < n; i++) z[i] = x[i] + h * ((44 / 45) * k1[i] - (56 / 15) * k2[i] + (32 / 9) * k3[i]);
    loop.rates(t + 0.8 * h, z, u, k4, y);
    for (let i = 0; i < n; i++) {
      const near = (19372 / 6561) * k1[i] - (25360 / 2187) * k2[i];
      z[i] = x[i] + h * (near + (64448 / 6561) * k3[i] - (212 / 729) * k4[i]);
    }
    loop.rates(t + (8 / 9) * h, z, u, k5, y);
    for (let i = 0; i < n; i++) {
      const near = (9017 / 3168) * k1[i] - (355 / 33) * k2[i] + (46732 / 5247) * k3[i];
      z[i] = x[i] + h * (near + (49 / 176) * k4[i] - (5103 / 18656) * k5[i]);
    }
    loop.rates(t + h, z, u, k6, y);
    for (let i = 0; i < n; i++) {
      const near = (35 / 384) * k1[i] + (500 / 1113) * k3[i] + (125 / 192) * k4[i];
      z[i] = x[i] + h * (near - (2187 / 6784) * k5[i] + (11 / 84) * k6[i]);
    }
    loop.rates(t + h, z, u, k7, y);
    let error = 0;
    for (let i = 0; i < n; i++) {
      const near = (71 / 57600) * k1[i] - (71 / 16695) * k3[i] + (71 / 1920) * k4[i];
      const off = h * (near - (17253 / 339200) * k5[i] + (22 / 525) * k6[i] - (1 / 40) * k7[i]);
      const size = Math.max(Math.abs(x[i]), Math.abs(z[i]));
      const ratio = Math.abs(off) / (ABSOLUTE_TOLERANCE * LOOP.nominal[i] + RELATIVE_TOLERANCE * size);
      if (!(ratio <= error)) error = ratio; // the largest: held states would make a mean small
    }
    return error;
  }

  return function advance(x, u, from, to) {
    let t = from;
    let h = Math.min(usual, to - from);
    loop.rates(t, x, u, k1, y);
    while (t < to) {
      const last = t + h * (1 + 1e-9) >= to;
      if (last) h = to - t;
      const error = tryStep(t, h, x, u);
      if (++steps > MOST_STEPS || Number.isNaN(error)) return false;
      if (error <= 1) {
        t = last ? to : t + h;
        x.set(z);
        k1.set(k7);
      }
      const next = h * Math.min(5, Math.max(0.2, 0.9 * Math.pow(error + 1e-10, -0.2)));
      if (error > 1 || !last || next > usual) usual = next; // a last step may be short without being refused
      h = next;
    }
    return true;
  };
}

function simulateLoop(p, x0, reference, horizon, points) {
  const loop = makeLoop(p);
  const advance = makeStepper(loop);
  const x = Float64Array.from(x0);
  const after = new Float64Array(x.length);
  const dx = new Float64Array(x.length);
  const y = new Float64Array(LOOP.outputs.length);
  const u = new Float64Array(LOOP.inputs.length);
  const input = LOOP.inputs.indexOf("reference");
  const t = Float64Array.from({ length: points + 1 }, (_, i) => (horizon * i) / points);
  const states = LOOP.states.map(() => new Float64Array(points + 1));
  const outputs = LOOP.outputs.map(() => new Float64Array(points + 1));
  const h = LOOP.sampleTime;
  const slack = 1e-9 * (h || 1); // an instant of a sample, as two products have it, is one
  const setInputs = (now) => {
    const [isAfter, disturbances] = [now >= reference.at - 1e-9, reference.inputs || []];
    u[input] = isAfter ? reference.final : reference.initial;
    for (const [place, value] of disturbances) u[place] = isAfter ? value : 0;
  };
  let sample = 0;
  let now = 0;
  for (let i = 0; i <= points; i++) {
    while (now < t[i]) {
      const next = h ? Math.min(t[i], Math.max(now, sample * h)) : reference.at > now && reference.at < t[i] ? reference.at : t[i];
      if (next > now) {
        if (!h) setInputs(now);
        if (!advance(x, u, now, next)) return null;
        now = next;
      }
      if (h && sample * h <= now + slack) sampleNow();
    }
    if (h && sample * h <= now + slack) sampleNow();
    if (!h) setInputs(now);
    loop.rates(now, x, u, dx, y);
    for (let j = 0; j < x.length; j++) states[j][i] = x[j];
    for (let j = 0; j < y.length; j++) outputs[j][i] = y[j];
  }
  return { t, states, outputs };

  function sampleNow() {
    setInputs(sample * h);
    loop.update(sample * h, x, u, after);
    x.set(after);
    sample++;
  }
}
