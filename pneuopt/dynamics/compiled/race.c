
/* A race of candidates over cases: each pair of both is a segment in a lane. While it runs, bounds of its values are read
   that can only grow, its merit's bound with them. A candidate whose bound passes its rival's merit is dropped with all
   its lanes, and the next pair takes the lane. What a candidate that comes through has put out is recorded.

   A response is read on its mean over a period (the same formula as `DitherPeriodMean` in evaluation/metric.py), of
   which the last output is the integral, or, with a period of 0, on itself. */

enum { SIGNAL, CONTROL };                                  /* of the outputs */
enum { SETTLING, OVERSHOOT, PEAK, IAE, ISE, ITAE, VALUES }; /* of the values whose bounds are read */
enum { FINAL, SIZE, INITIAL, SPACING, OFFSET, IS_STEP, BAND_UNIT, SETTINGS };
#define ROUNDING 1e-9 /* share by which a bound must pass: at 0 a rounding would drop what ties; more runs longer */

typedef struct {
  Count cases, samples, bands, every; /* cases, samples of the longest, settling bands, samples between states kept */
  int substeps;
  double worst_merit, penalty, runaway;
  const double *u, *t, *h;       /* by grid: inputs, instants and steps of each sample */
  const Count *grid, *length, *first; /* by case: its grid, its samples, the first one from the step on */
  const double *settings;        /* by case: SETTINGS */
  const double *p, *x0, *period; /* by candidate and case */
  const Count *order;            /* by candidate: its cases in the order in which they run */
  const double *rival;           /* by candidate: the merit to beat */
  const double *band, *weight, *limit; /* half widths of the bands; the objective's weights and the limits of the values */
  double *y, *x, *x_end;         /* by candidate and case: outputs of each sample, states kept, and the last state */
  Count *loser;                  /* by candidate: the case by which it lost; -1: it came through */
  double *worst;                 /* by candidate: VALUES, the worst over its cases so far */
  const volatile int *stop;      /* as for `step_through` */
} Race;

typedef struct {
  Count candidate, which, pair, sample; /* candidate -1: the lane is idle */
  Count half;                           /* whole samples in half a period */
  double near, far, slope_near, slope_far, error, sums[VALUES];
} Runner;

static double merit_bound(const Race *r, const double *values) {
  double missed = 0, total = 0;
  for (int k = 0; k < VALUES; k++) {
    if (values[k] > r->limit[k] * (1 + ROUNDING)) missed += r->penalty * (values[k] / r->limit[k] - 1);
    total += r->weight[k] * values[k];
  }
  return missed > 0 ? r->worst_merit * (1 + missed) : total < r->worst_merit ? total : r->worst_merit;
}

/* The response's distance from the reference at sample k from the step on, as a fraction of the step. */
static double read_error(const Race *r, const Runner *run, Count k) {
  const double *set = r->settings + run->which * SETTINGS, h = set[SPACING];
  const double *y = r->y + (run->pair * r->samples + r->first[run->which]) * NY;
  if (r->period[run->pair] == 0) return (y[k * NY + SIGNAL] - set[FINAL]) / set[SIZE];
  const Count ends[4] = {k + run->half, k - run->half, k + run->half + 1, k - run->half - 1};
  double signal[4], integral[4];
  for (int i = 0; i < 4; i++) {
    const Count at = ends[i];
    signal[i] = at < 0 ? set[INITIAL] : y[at * NY + SIGNAL];
    integral[i] = at < 0 ? at * (h * set[INITIAL]) : y[at * NY + NY - 1] - y[NY - 1];
  }
  const double total = run->near * (integral[0] - integral[1]) + run->far * (integral[2] - integral[3]) +
                       run->slope_near * (signal[0] + signal[1]) + run->slope_far * (signal[2] + signal[3]);
  return (total / r->period[run->pair] - set[FINAL]) / set[SIZE];
}

/* The bounds that grow with the sample just put out; whether the candidate has lost by them. */
static int has_lost(const Race *r, Runner *run, double *exits) {
  const double *set = r->settings + run->which * SETTINGS, period = r->period[run->pair];
  const double *y = r->y + (run->pair * r->samples + run->sample) * NY;
  double *worst = r->worst + run->candidate * VALUES, *sums = run->sums;
  const Count after = run->sample - r->first[run->which], k = after - (period == 0 ? 0 : run->half + 1);
  const double rival = r->rival[run->candidate];
  if (!(fabs(y[SIGNAL]) < r->runaway && fabs(y[CONTROL]) < r->runaway)) return rival < INFINITY;
  if (after < 0) return 0;
  if (fabs(y[CONTROL]) > worst[PEAK]) worst[PEAK] = fabs(y[CONTROL]);
  if (k >= 0) {
    const double *at = r->t + r->grid[run->which] * r->samples + r->first[run->which];
    const double error = read_error(r, run, k), size = fabs(error), t = set[OFFSET] + at[k] - at[0];
    double settling = 0;
    for (Count b = 0; b < r->bands; b++) {
      if (size > r->band[b] * set[BAND_UNIT]) exits[b] = t - period / 2; /* the ripple may carry it back that much sooner */
      settling += exits[b] / r->bands;
    }
    if (k > 0) {
      const double before = run->error, last = set[OFFSET] + at[k - 1] - at[0], h = t - last;
      sums[IAE] += h / 2 * (fabs(before) + size);
      sums[ISE] += h / 2 * (before * before + error * error);
      sums[ITAE] += h / 2 * (last * fabs(before) + t * size);
    }
    run->error = error;
    sums[SETTLING] = settling, sums[OVERSHOOT] = set[IS_STEP] ? error : size;
    for (int v = 0; v < VALUES; v++)
      if (v != PEAK && sums[v] > worst[v]) worst[v] = sums[v];
  }
  return merit_bound(r, worst) > rival + ROUNDING * fabs(rival);
}

/* The next pair that is to run: every candidate's first case, then the second ones of those still in the race, ... */
static Count next_pair(const Race *r, Count begin, Count end, Count *place) {
  for (; *place < (end - begin) * r->cases; ++*place) {
    const Count candidate = begin + *place % (end - begin), turn = *place / (end - begin);
    if (r->loser[candidate] < 0) {
      ++*place;
      return candidate * r->cases + r->order[candidate * r->cases + turn];
    }
  }
  return -1;
}

static void enter(const Race *r, Segment *s, Runner *run, double *exits, int lane, Count pair) {
  memset(run, 0, sizeof(*run)), memset(exits, 0, sizeof(double) * r->bands);
  run->pair = pair, run->candidate = pair / r->cases, run->which = pair % r->cases;
  const double h = r->settings[run->which * SETTINGS + SPACING], period = r->period[pair];
  run->half = (Count)(period / 2 / h + 1e-9);
  const double share = period / 2 / h - run->half, rest = 1 - share;
  run->near = (1 + 2 * share) * rest * rest, run->far = share * share * (3 - 2 * share);
  run->slope_near = h * share * rest * rest, run->slope_far = -h * share * share * rest;
  for (int i = 0; i < NX; i++) PUT(s->x[i], lane, r->x0[pair * NX + i]);
  for (int i = 0; i < NP; i++) PUT(s->p[i], lane, r->p[pair * NP + i]);
}

EXPORT void race(const Race *r, Count begin, Count end) {
  Segment s;
  Runner run[LANES];
  double exits[LANES][LENGTH(r->bands)];
  Count place = 0, idle = LANES;
  memset(&s, 0, sizeof(s));
  for (int lane = 0; lane < LANES; lane++) run[lane].candidate = -1;
  for (;;) {
    int entered = 0;
    for (int lane = 0; lane < LANES; lane++) {
      if (run[lane].candidate >= 0 && r->loser[run[lane].candidate] >= 0) run[lane].candidate = -1, idle++;
      if (run[lane].candidate >= 0) continue;
      const Count pair = next_pair(r, begin, end, &place);
      if (pair >= 0) enter(r, &s, run + lane, exits[lane], lane, pair), entered = 1, idle--;
    }
    if (idle == LANES || *r->stop) return;
    if (entered) start(&s);
    for (int lane = 0; lane < LANES; lane++) {
      if (run[lane].candidate < 0) continue;
      const Count row = r->grid[run[lane].which] * r->samples + run[lane].sample, k = run[lane].sample / r->every;
      if (run[lane].sample % r->every == 0)
        for (int i = 0; i < NX; i++) r->x[(run[lane].pair * ((r->samples - 1) / r->every + 1) + k) * NX + i] = GET(s.x[i], lane);
      PUT(s.t[0], lane, r->t[row]), PUT(s.h[0], lane, r->h[row]);
      for (int i = 0; i < NU; i++) PUT(s.u[i], lane, r->u[row * NU + i]);
    }
    read_sample(&s);
    for (int lane = 0; lane < LANES; lane++) {
      Runner *own = run + lane;
      if (own->candidate < 0) continue;
      double *y = r->y + (own->pair * r->samples + own->sample) * NY;
      for (int i = 0; i < NY; i++) y[i] = GET(s.y[i], lane);
      if (r->loser[own->candidate] < 0 && has_lost(r, own, exits[lane])) r->loser[own->candidate] = own->which;
      if (++own->sample < r->length[own->which]) continue;
      for (int i = 0; i < NX; i++) r->x_end[own->pair * NX + i] = GET(s.x[i], lane);
      own->candidate = -1, idle++;
    }
    step_through(&s, r->substeps, r->stop);
  }
}
