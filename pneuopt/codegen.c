/* The run of one sampled system over many segments, around the C that CasADi generates for one of its steps.

   The generated file (GENERATED) defines system_update, system_step and system_output with CasADi's calling convention; NX, NU, NP, NY and NS
   are the sizes of the state, input, parameter and output vectors and the number of sensitivity columns S = dx/d(start,
   parameters). All arrays are C-contiguous with the segment first; a null pointer leaves that result out. */

#include <string.h>

#include GENERATED

#define LENGTH(n) ((n) > 0 ? (n) : 1)

typedef struct {
  double t, h, x[LENGTH(NX)], u[LENGTH(NU)], p[LENGTH(NP)], S[LENGTH(NX * NS)];
  double x_next[LENGTH(NX)], S_next[LENGTH(NX * NS)], y[LENGTH(NY)], dy[LENGTH(NY * NS)], w[LENGTH(WORK)];
} Segment;

static void advance(Segment *s) {
  memcpy(s->x, s->x_next, sizeof(double) * NX);
  memcpy(s->S, s->S_next, sizeof(double) * NX * NS);
}

static void run_sample(Segment *s, double t, double h, int substeps) {
  const double *at[5] = {&s->t, s->x, s->u, s->p, s->S};
  const double *over[6] = {&s->t, &s->h, s->x, s->u, s->p, s->S};
  double *state[2] = {s->x_next, s->S_next}, *outputs[2] = {s->y, s->dy};
  s->t = t;
#if HAS_UPDATE
  system_update(at, state, 0, s->w, 0);
  advance(s);
#endif
  system_output(at, outputs, 0, s->w, 0);
  s->h = h / substeps;
  for (int k = 0; k < substeps; k++) {
    s->t = t + k * s->h;
    system_step(over, state, 0, s->w, 0);
    advance(s);
  }
}

CASADI_SYMBOL_EXPORT void rollout(long long first, long long last, long long n, int substeps, long long p_stride,
                                  const double *x0, const double *u, const double *p, const double *t, const double *h,
                                  double *y, double *dy, double *x, double *x_end, double *dx_end) {
  Segment s;
  for (long long i = first; i < last; i++) {
    memcpy(s.x, x0 + i * NX, sizeof(double) * NX);
    memcpy(s.p, p + i * p_stride, sizeof(double) * NP);
    memset(s.S, 0, sizeof(s.S));
    for (int c = 0; c < STARTS; c++) s.S[c * NX + c] = 1;
    for (long long j = i * n; j < (i + 1) * n; j++) {
      memcpy(s.u, u + j * NU, sizeof(double) * NU);
      if (x) memcpy(x + j * NX, s.x, sizeof(double) * NX);
      run_sample(&s, t[j], h[j], substeps);
      if (y) memcpy(y + j * NY, s.y, sizeof(double) * NY);
      if (dy) memcpy(dy + j * NY * NS, s.dy, sizeof(double) * NY * NS);
    }
    if (x_end) memcpy(x_end + i * NX, s.x, sizeof(double) * NX);
    if (dx_end) memcpy(dx_end + i * NX * NS, s.S, sizeof(double) * NX * NS);
  }
}
