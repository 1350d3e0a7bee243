/* The run of one sampled system over many segments, a segment a lane, around the C that `emission` writes for its pieces.

   NX, NU, NP, NY and NS are the sizes of the state, input, parameter and output vectors and the number of sensitivity
   columns S = dx/d(start, parameters). All arrays are C-contiguous with the segment first; a null pointer leaves that
   result out. With measured outputs (NaN: none) and their weights, the Gram matrix of [dy | y - measured], weighted, is
   summed over a segment's samples, and so is the weighted dy, which itself is never stored. */

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#endif
#define LENGTH(n) ((n) > 0 ? (n) : 1)
#define WIDTH (NS + 1)

typedef struct {
  Lanes t[1], h[1], x[LENGTH(NX)], u[LENGTH(NU)], p[LENGTH(NP)], S[LENGTH(NX * NS)];
  Lanes x_next[LENGTH(NX)], S_next[LENGTH(NX * NS)], y[LENGTH(NY)], dy[LENGTH(NY * NS)];
  Lanes measured[LENGTH(NY)], weight[LENGTH(NY)], gram[WIDTH * WIDTH], squares[LENGTH(NY)];
  Lanes sums[LENGTH(NY * NS)];
  Lanes step_kept[LENGTH(STEP_KEPT)], output_kept[LENGTH(OUTPUT_KEPT)], update_kept[LENGTH(UPDATE_KEPT)];
} Segment;

#include PIECES

const int rollout_lanes = LANES;

typedef long long Count;

static void gather(Lanes *v, const double *from, const Count *row, Count size) {
  for (int lane = 0; lane < LANES; lane++)
    for (Count i = 0; i < size; i++) PUT(v[i], lane, from[row[lane] * size + i]);
}

static void scatter(const Lanes *v, double *to, const Count *row, Count size, int lanes) {
  if (!to) return;
  for (int lane = 0; lane < lanes; lane++)
    for (Count i = 0; i < size; i++) to[row[lane] * size + i] = GET(v[i], lane);
}

static void advance(Segment *s) {
  memcpy(s->x, s->x_next, sizeof(Lanes) * NX);
  memcpy(s->S, s->S_next, sizeof(Lanes) * NX * NS);
}

static void start(Segment *s) {
  memset(s->S, 0, sizeof(s->S)), memset(s->gram, 0, sizeof(s->gram)), memset(s->squares, 0, sizeof(s->squares));
  memset(s->sums, 0, sizeof(s->sums));
  for (int c = 0; c < STARTS; c++) s->S[c * NX + c] = ALL(1.0);
#if HAS_UPDATE
  update_segment(s);
#endif
  output_segment(s), step_segment(s);
}

static void read_sample(Segment *s) {
#if HAS_UPDATE
  update_sample(s), update_call(s), advance(s);
#endif
  output_sample(s), output_call(s);
}

static void add_residuals(Segment *s) {
  Lanes e[WIDTH];
  for (int i = 0; i < NY; i++) {
    const Lanes known = v_eq(s->measured[i], s->measured[i]), weight = s->weight[i];
    for (int a = 0; a < NS; a++) {
      e[a] = v_if_else_zero(known, s->dy[a * NY + i] * weight);
      s->sums[a * NY + i] += e[a];
    }
    e[NS] = v_if_else_zero(known, (s->y[i] - s->measured[i]) * weight);
    s->squares[i] += e[NS] * e[NS];
    for (int a = 0; a < WIDTH; a++)
      for (int b = 0; b <= a; b++) s->gram[a * WIDTH + b] += e[a] * e[b];
  }
}

static void mirror(Segment *s) {
  for (int a = 0; a < WIDTH; a++)
    for (int b = 0; b < a; b++) s->gram[b * WIDTH + a] = s->gram[a * WIDTH + b];
}

/* `stop` becomes 1 when the caller is interrupted and wants none of the results any more. */
static void step_through(Segment *s, int substeps, const volatile int *stop) {
  const Lanes t = s->t[0];
  s->h[0] = s->h[0] / ALL(substeps);
  step_sample(s);
  for (int k = 0; k < substeps && !*stop; k++) {
    s->t[0] = t + ALL(k) * s->h[0];
    step_call(s);
    advance(s);
  }
}

EXPORT void rollout(Count first, Count last, Count n, int substeps, Count p_stride, Count u_stride,
                                  Count t_stride, Count every,
                                  const double *x0, const double *u, const double *p, const double *t, const double *h,
                                  const double *measured, const double *weight, double *y, double *dy, double *x,
                                  double *x_end, double *dx_end, double *gram, double *squares,
                                  double *sums, const volatile int *stop) {
  Segment s;
  for (Count i = first; i < last; i += LANES) {
    const int lanes = last - i < LANES ? (int)(last - i) : LANES;
    Count row[LANES], sample[LANES], held[LANES], at[LANES], kept[LANES];
    /* idle lanes repeat the last segment and write nothing */
    for (int lane = 0; lane < LANES; lane++) row[lane] = i + (lane < lanes ? lane : lanes - 1);
    gather(s.x, x0, row, NX);
    for (int lane = 0; lane < LANES; lane++)
      for (int k = 0; k < NP; k++) PUT(s.p[k], lane, p[row[lane] * p_stride + k]);
    start(&s);
    for (Count j = 0; j < n; j++) {
      for (int lane = 0; lane < LANES; lane++) sample[lane] = row[lane] * n + j;
      for (int lane = 0; lane < LANES; lane++) held[lane] = row[lane] * u_stride + j, at[lane] = row[lane] * t_stride + j;
      gather(s.u, u, held, NU), gather(s.t, t, at, 1), gather(s.h, h, at, 1);
      if (j % every == 0) {
        for (int lane = 0; lane < LANES; lane++) kept[lane] = row[lane] * ((n - 1) / every + 1) + j / every;
        scatter(s.x, x, kept, NX, lanes);
      }
      read_sample(&s);
      scatter(s.y, y, sample, NY, lanes), scatter(s.dy, dy, sample, NY * NS, lanes);
      if (gram) {
        gather(s.measured, measured, sample, NY), gather(s.weight, weight, sample, NY);
        add_residuals(&s);
      }
      step_through(&s, substeps, stop);
      if (*stop) return;
    }
    mirror(&s);
    scatter(s.gram, gram, row, WIDTH * WIDTH, lanes), scatter(s.squares, squares, row, NY, lanes);
    scatter(s.sums, sums, row, NY * NS, lanes);
    scatter(s.x, x_end, row, NX, lanes), scatter(s.S, dx_end, row, NX * NS, lanes);
  }
}
