// The part of a page that moves: sliders set parameters, the loop is integrated at once, and redrawn.
// Uses LOOP, makeLoop and simulateLoop of the loop, findRest, and DATA: values, sliders, references (each with its band), limits, units.
const POINTS = 600; // instants of a response: fewer show corners, more cost time in a frame
const AGREEMENT = 0.02; // share by which a figure of the design may differ from its certificate and count as the same
const LEAST = { SettlingTime: 2e-3, Overshoot: 0.1, PeakControl: 0 }; // the same near zero, in the figures' units
const COLOURS = { now: "#1f6fb2", was: "#8b949e", wanted: "#e07b00", band: "#fbe3c8", ink: "#1b1f24", line: "#d0d7de" };

function format(value) {
  return Number(value.toPrecision(4)).toString();
}

function sliderValue(slider, share) {
  const { low, high } = slider;
  return slider.isLog ? low * Math.pow(high / low, share) : low + (high - low) * share;
}

function sliderShare(slider, value) {
  const { low, high } = slider;
  return slider.isLog ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
}

// The mean over a dither period around each instant; of a loop without dither the signal itself. Before its first instant
// the signal rests; in its last half period the mean goes on as fast as it went.
function ditherMean(t, y, period) {
  const step = t[1] - t[0];
  if (!(period > 2 * step)) return Array.from(y);
  const reach = period / 2 / step;
  const sums = [0]; // trapezia up to each instant
  for (let i = 1; i < y.length; i++) sums.push(sums[i - 1] + (y[i - 1] + y[i]) / 2);
  const upTo = (place) => {
    if (place <= 0) return place * y[0];
    const i = Math.min(Math.floor(place), y.length - 2);
    const part = place - i;
    return sums[i] + part * (y[i] + (part / 2) * (y[i + 1] - y[i]));
  };
  const found = [];
  for (let i = 0; i + reach <= y.length - 1; i++) found.push((upTo(i + reach) - upTo(i - reach)) / (2 * reach));
  const last = y.length - 1;
  const begin = Math.max(0, last - 2 * reach);
  const i = Math.min(Math.floor(begin), last - 1);
  const slope = (y[last] - y[i] - (begin - i) * (y[i + 1] - y[i])) / (2 * reach);
  while (found.length && found.length < y.length) found.push(found[found.length - 1] + slope);
  return found;
}

function ditherPeriod(p) {
  const value = (name) => p[LOOP.parameters.indexOf(name)] || 0;
  return value("dither.amplitude") ? 1 / value("dither.frequency") : 0;
}

// Since when a signal stays in the band, by the rule of SettlingBand: NaN is outside, and never is Infinity.
function settlingTime(t, y, reference) {
  const reach = reference.band * Math.abs(reference.size);
  const end = y.length - 1;
  let k = end;
  while (k >= 0 && t[k] >= reference.at && Math.abs(y[k] - reference.final) <= DATA.rule.edge * reach) k--;
  if (k < 0 || t[k] < reference.at) return 0;
  if (k === end) return Infinity;
  const edge = reference.final + reach * Math.sign(y[k] - reference.final);
  const settled = t[k] + ((t[k + 1] - t[k]) * (edge - y[k])) / (y[k + 1] - y[k]) - reference.at;
  return settled <= (1 - DATA.rule.tail) * (t[end] - reference.at) ? settled : Infinity;
}

// Of a disturbance alone, as the certificate: either side of the reference, as a share of the reference's own scale.
function readMetrics(run, p, reference) {
  const t = run.t;
  const raw = run.outputs[DATA.measured];
  const period = ditherPeriod(p);
  const y = ditherMean(t, raw, period);
  const { size } = reference;
  const control = run.outputs[run.outputs.length - 1];
  let over = 0;
  for (let i = 0; i < y.length; i++) {
    if (t[i] < reference.at) continue;
    const off = (y[i] - reference.final) / size;
    over = Math.max(over, reference.isStep ? off : Math.abs(off));
  }
  const peak = control.reduce((most, v) => Math.max(most, Math.abs(v)), 0);
  const settled = settlingTime(t, y, reference);
  const late = t[t.length - 1] - reference.at - DATA.rule.periods * period; // from there on a mean may just pass
  const passes = settled > late && settlingTime(t, raw, reference) === Infinity;
  return { SettlingTime: passes ? Infinity : settled, Overshoot: 100 * over, PeakControl: peak };
}

function quantity(slider, value) {
  return `${format(value * slider.scale)}${slider.unit === "1" ? "" : " " + slider.unit}`;
}

function tuningText(p) {
  const sections = {};
  for (const slider of DATA.sliders) {
    const [section, name] = slider.name.split(".");
    if (!DATA.controller.includes(section)) continue;
    (sections[section] ||= []).push(`${name} = "${quantity(slider, p[slider.place])}"`);
  }
  return Object.entries(sections).map(([name, lines]) => [`[${name}]`, ...lines].join("\n")).join("\n");
}

function element(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

function drawCurves(canvas, label, curves, spans) {
  const scale = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = width * scale;
  canvas.height = height * scale;
  const pen = canvas.getContext("2d");
  pen.scale(scale, scale);
  pen.font = "12px system-ui, sans-serif";
  const ends = (values) => [Math.min(...values), Math.max(...values)];
  const [left, right] = ends(curves.flatMap((c) => ends(Array.from(c.x))));
  let [low, high] = ends([...curves.flatMap((c) => ends(Array.from(c.y))), ...spans.flat()]);
  const room = 0.06 * (high - low) || 1;
  [low, high] = [low - room, high + room];
  const box = { x: 70, y: 20, w: width - 82, h: height - 44 };
  const X = (v) => box.x + (box.w * (v - left)) / (right - left || 1);
  const Y = (v) => box.y + box.h * (1 - (v - low) / (high - low));
  pen.fillStyle = COLOURS.band;
  for (const [from, to] of spans) pen.fillRect(box.x, Y(to), box.w, Y(from) - Y(to));
  pen.strokeStyle = COLOURS.line;
  pen.strokeRect(box.x, box.y, box.w, box.h);
  pen.fillStyle = COLOURS.ink;
  pen.fillText(label, box.x, 13);
  pen.textAlign = "right";
  for (const v of [low + room, high - room]) pen.fillText(v.toPrecision(3), box.x - 5, Y(v) + 4);
  pen.textAlign = "center";
  for (const v of [left, (left + right) / 2, right]) pen.fillText(format(v), X(v), box.y + box.h + 16);
  for (const { x, y, colour, width: w } of curves) {
    pen.beginPath();
    pen.strokeStyle = colour;
    pen.lineWidth = w || 1.6;
    for (let i = 0; i < x.length; i++) pen.lineTo(X(x[i]), Y(y[i]));
    pen.stroke();
  }
}

function startPage() {
  const place = document.getElementById("live");
  const p = Float64Array.from(DATA.values);
  let chosen = 0;
  let first = null;
  const lamps = element("p", { class: "lamps", "aria-live": "polite" });
  const text = element("textarea", { readonly: "", rows: "8", "aria-label": "the controller as in a tuning.toml" });
  const canvases = ["response", "command", "phase"].map((n) => element("canvas", { role: "img", "aria-label": n }));
  const sliders = element("div", { class: "sliders" });
  for (const slider of DATA.sliders) {
    const shown = element("output", {});
    const input = element("input", { type: "range", min: "0", max: "1", step: "0.001", "aria-label": slider.name });
    const set = (value) => {
      p[slider.place] = value;
      shown.textContent = quantity(slider, value);
    };
    slider.reset = () => {
      input.value = sliderShare(slider, DATA.values[slider.place]);
      set(DATA.values[slider.place]);
    };
    slider.reset();
    input.addEventListener("input", () => (set(sliderValue(slider, Number(input.value))), draw()));
    sliders.append(element("label", {}, element("span", {}, slider.name), input, shown));
  }
  const select = element("select", { "aria-label": "reference" });
  DATA.references.forEach((r, k) => select.append(element("option", { value: k }, r.label)));
  select.addEventListener("change", () => ((chosen = Number(select.value)), (first = null), draw()));
  const reset = element("button", { type: "button" }, "back to the design");
  reset.addEventListener("click", () => (DATA.sliders.forEach((s) => s.reset()), draw()));
  const copy = element("button", { type: "button" }, "copy as tuning.toml");
  copy.addEventListener("click", () => (text.select(), document.execCommand("copy")));
  place.append(element("p", {}, select, " ", reset, " ", copy), lamps, ...canvases, sliders, text);
  place.hidden = false;
  const link = document.getElementById("live-link");
  if (link) link.hidden = false;

  function draw() {
    const reference = DATA.references[chosen];
    const begin = findRest(p, reference);
    const run = begin && simulateLoop(p, begin, reference, reference.horizon, POINTS);
    first ||= simulateLoop(Float64Array.from(DATA.values), reference.x0, reference, reference.horizon, POINTS);
    text.value = tuningText(p);
    lamps.replaceChildren();
    if (!run || !first) {
      const why = begin
        ? "the loop leaves what its model describes, or is too stiff for a page"
        : "the plant has no rest or steady motion to begin at: it cannot hold this, or its command would be clipped";
      lamps.append(element("span", { class: "bad" }, why));
      return;
    }
    const design = readMetrics(first, DATA.values, reference);
    for (const [name, value] of Object.entries(readMetrics(run, p, reference))) {
      const certified = reference.certified[name];
      const agrees = Math.abs(design[name] - certified) <= AGREEMENT * Math.abs(certified) + LEAST[name];
      const limit = agrees ? DATA.limits[name] : undefined; // no verdict on what is not read as the certificate reads it
      const kind = limit === undefined ? "plain" : value <= limit ? "good" : "bad";
      const asked = limit === undefined ? "" : ` (${value <= limit ? "keeps" : "breaks"} <= ${format(limit)})`;
      const figure = Number.isFinite(value) ? `${format(value)} ${DATA.units[name]}` : "never";
      lamps.append(element("span", { class: kind }, `${name} ${figure}${asked}`), " ");
    }
    const pair = (of, get, unit) => (of ? [{ x: of.t, y: get(of), colour: unit }] : []);
    const signal = (r) => r.outputs[DATA.measured];
    const control = (r) => r.outputs[r.outputs.length - 1];
    const size = reference.band * Math.abs(reference.size);
    const wanted = { x: [0, reference.at, reference.at, reference.horizon], colour: COLOURS.wanted, width: 1 };
    wanted.y = [reference.initial, reference.initial, reference.final, reference.final];
    const both = (get) => [...pair(first, get, COLOURS.was), ...pair(run, get, COLOURS.now)];
    const span = [[reference.final - size, reference.final + size]];
    drawCurves(canvases[0], `${DATA.labels[0]} over time [s]; grey: the design`, [wanted, ...both(signal)], span);
    drawCurves(canvases[1], `${DATA.labels[1]} over time [s]`, both(control), []);
    const slope = (r) => signal(r).map((v, i, y) => (y[Math.min(i + 1, POINTS)] - y[Math.max(i - 1, 0)]) / (r.t[2] - r.t[0]));
    const plane = (r, colour) => (r ? [{ x: signal(r), y: slope(r), colour }] : []);
    const curves = [...plane(first, COLOURS.was), ...plane(run, COLOURS.now)];
    drawCurves(canvases[2], `phase plane: slope of ${DATA.labels[0]} over it`, curves, []);
  }
  draw();
  window.addEventListener("resize", draw);
}

if (typeof document !== "undefined") startPage();
