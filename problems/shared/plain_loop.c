/* A closed loop by classical Runge-Kutta with small steps, in plain C: a check on designs that shares no line with pneuopt.

   Plants (kind), their states and parameters p:
   0  y'' + 2 z w y' + w^2 y = K w^2 u                     y, y'                        K w z
   1  T y' + y = K u(t - L), the commands remembered        y                            K T L
   2  kind 0 with friction F(y) [input's unit]             y, d                         K w z  Fc Fs vs B smoothing
   3  M v' = u - f - F(v)                                  x, v                         M f    Fc Fs vs B smoothing
   4  the same with LuGre bristles                         x, v, z                      M f    Fc Fs vs B s0 s1 vd
   5  cylinder, 5/3 valve, LuGre                           x, v, pa, pb, s, s', z       see `enum` below
   The measured signal is y; of kinds 3 to 5 the speed, or the position where `position` is 1. */
#include <math.h>
#include <stdlib.h>

#define MAX_STATES 12
#define TWO_PI 6.283185307179586
enum { M, F, FC, FS, VS, B, S0, S1, VD, BORE, ROD, STROKE, DA, DB, C, BCR, DZ, ROUND, LEAK, SPAN, BW, ZETA, PS, PO, TS, RGAS, N,
       CORNER, ZERO, PWIDTH, KSTOP, DSTOP };

typedef struct {
    int kind, position, limited;
    const double *p;
    double Kp, Ki, Kd, Tf, b, c, Tt, low, high, sample, amplitude, offset, frequency;
    int analogue;
    double r;
    double *past, before, h; /* of kind 1: the commands at steps of h, a ring of `size`, and the one so far */
    long size;
} Loop;

static const int plant_states[] = {2, 1, 2, 2, 3, 7};

static double stribeck(double v, double fc, double fs, double vs) { return fc + (fs - fc) * exp(-(v / vs) * (v / vs)); }

static double lugre(double v, double z, double fc, double fs, double vs, double b, double s0, double s1, double vd, double *dz) {
    *dz = v - s0 * sqrt(v * v + 1e-12) * z / stribeck(v, fc, fs, vs);
    return s0 * z + s1 * exp(-(v / vd) * (v / vd)) * *dz + b * v;
}

static double orifice(double p1, double p2, const double *p) {
    double d = p1 - p2, high = 0.5 * (p1 + p2 + sqrt(d * d + p[PWIDTH] * p[PWIDTH]));
    double raw = d / (high * (1 - p[BCR])), e = p[CORNER];
    double z = 0.5 * (sqrt((raw + 1) * (raw + 1) + e * e) - sqrt((raw - 1) * (raw - 1) + e * e));
    double s = sqrt(z * z + p[ZERO] * p[ZERO]);
    return high * z / s * sqrt(s * (2 - s));
}

static double edge(double x, const double *p) {
    double d = x - p[DZ];
    return 0.5 * (d + sqrt(d * d + p[ROUND] * p[ROUND])) + p[LEAK];
}

/* of a cover: 0 up to 0.1 mm before it, the depth from 0.1 mm beyond it */
static double compression(double depth) {
    double w = depth / 1e-4;
    return w <= -1 ? 0 : w >= 1 ? depth : 1e-4 * (w + 1) * (w + 1) * (w + 1) * (3 - w) / 16;
}

static void cylinder(const double *x, double u, const double *p, double *d) {
    double Aa = TWO_PI / 8 * p[BORE] * p[BORE], Ab = Aa - TWO_PI / 8 * p[ROD] * p[ROD];
    double Va = p[DA] + Aa * x[0], Vb = p[DB] + Ab * (p[STROKE] - x[0]), w = TWO_PI * p[BW];
    double scale = p[C] * 1.185 * sqrt(293.15 / p[TS]), dz;
    double wa = scale * (edge(x[4], p) * orifice(p[PS], x[2], p) - edge(-x[4], p) * orifice(x[2], p[PO], p));
    double wb = scale * (edge(-x[4], p) * orifice(p[PS], x[3], p) - edge(x[4], p) * orifice(x[3], p[PO], p));
    double friction = lugre(x[1], x[6], p[FC], p[FS], p[VS], p[B], p[S0], p[S1], p[VD], &dz);
    double command = fmax(-1, fmin(1, u / p[SPAN]));
    double rear = compression(-x[0]), front = compression(x[0] - p[STROKE]);
    double stop = p[KSTOP] * (rear * (1 - p[DSTOP] * x[1]) - front * (1 + p[DSTOP] * x[1]));
    d[0] = x[1];
    d[1] = (stop + Aa * (x[2] - p[PO]) - Ab * (x[3] - p[PO]) - friction - p[F]) / p[M];
    d[2] = p[N] * (p[RGAS] * p[TS] * wa - x[2] * Aa * x[1]) / Va;
    d[3] = p[N] * (p[RGAS] * p[TS] * wb + x[3] * Ab * x[1]) / Vb;
    d[4] = x[5];
    d[5] = w * w * (command - x[4]) - 2 * p[ZETA] * w * x[5];
    d[6] = dz;
}

void plant_rates(int kind, const double *x, double u, const double *p, double *d) {
    double force;
    switch (kind) {
    case 0:
        d[0] = x[1], d[1] = p[1] * p[1] * (p[0] * u - x[0]) - 2 * p[2] * p[1] * x[1];
        break;
    case 1:
        d[0] = (p[0] * u - x[0]) / p[1];
        break;
    case 2:
        force = stribeck(x[0], p[3], p[4], p[5]) * tanh(x[0] / p[7]) + p[6] * x[0];
        d[0] = x[1] - p[0] * p[1] / (2 * p[2]) * force, d[1] = p[1] * p[1] * (p[0] * u - x[0]) - 2 * p[2] * p[1] * x[1];
        break;
    case 3:
        force = stribeck(x[1], p[2], p[3], p[4]) * tanh(x[1] / p[6]) + p[5] * x[1];
        d[0] = x[1], d[1] = (u - p[1] - force) / p[0];
        break;
    case 4:
        force = lugre(x[1], x[2], p[2], p[3], p[4], p[5], p[6], p[7], p[8], &d[2]);
        d[0] = x[1], d[1] = (u - p[1] - force) / p[0];
        break;
    default:
        cylinder(x, u, p, d);
    }
}

static double measured(const Loop *l, const double *x) { return l->kind >= 3 && !l->position ? x[1] : x[0]; }

static double clip(const Loop *l, double w) { return l->limited ? fmin(fmax(w, l->low), l->high) : w; }

static double wave(const Loop *l, double t) { return l->amplitude * sin(TWO_PI * l->frequency * t); }

/* Continuous: the integral and the filter follow the plant's states. Sampled: `held` is the command. */
static double command(const Loop *l, double t, const double *x, double held, double *rates) {
    int n = plant_states[l->kind];
    double y = measured(l, x), error = l->c * l->r - y, w, u;
    if (l->sample > 0) return l->analogue ? clip(l, held + wave(l, t)) : held;
    w = l->Kp * (l->b * l->r - y) + x[n] + l->Kd / l->Tf * (error - x[n + 1]) + l->offset + wave(l, t);
    u = clip(l, w);
    rates[0] = l->Ki == 0 ? -x[n] / l->Tt : l->Ki * (l->r - y) + (l->limited ? (u - w) / l->Tt : 0);
    rates[1] = (error - x[n + 1]) / l->Tf;
    return u;
}

/* The command as long ago as the dead time, which is a step or more; between two steps on a line. */
static double late(const Loop *l, double t) {
    double at = (t - l->p[2]) / l->h + 1e-9, share;
    long i = (long)floor(at);
    if (at < 0) return l->before;
    share = at - i;
    return (1 - share) * l->past[i % l->size] + share * l->past[(i + 1) % l->size];
}

static void slope(const Loop *l, double t, const double *x, double held, double *d) {
    double u = command(l, t, x, held, d + plant_states[l->kind]);
    plant_rates(l->kind, x, l->kind == 1 ? late(l, t) : u, l->p, d);
}

static void advance(const Loop *l, double t, double h, int n, double *x, double held) {
    double k1[MAX_STATES], k2[MAX_STATES], k3[MAX_STATES], k4[MAX_STATES], y[MAX_STATES];
    slope(l, t, x, held, k1);
    for (int i = 0; i < n; i++) y[i] = x[i] + h / 2 * k1[i];
    slope(l, t + h / 2, y, held, k2);
    for (int i = 0; i < n; i++) y[i] = x[i] + h / 2 * k2[i];
    slope(l, t + h / 2, y, held, k3);
    for (int i = 0; i < n; i++) y[i] = x[i] + h * k3[i];
    slope(l, t + h, y, held, k4);
    for (int i = 0; i < n; i++) x[i] += h / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]);
}

/* Runs `count` recorded samples of `every` steps of h; a controller's sample takes `per_sample` steps. x0 holds the plant's
   state, u0 its command, r0 the reference so far. Ends early where the position leaves low..high. Returns the samples written. */
long run_loop(int kind, int position, const double *p, const double *c, double r0, double r1, const double *x0, double u0,
              double h, long count, long every, long per_sample, double low, double high, double *t_out, double *y_out,
              double *u_out) {
    Loop l = {kind, position, c[8] != 0, p, c[0], c[1], c[2], c[3], c[4], c[5], c[9], c[6], c[7], c[10], c[11], c[12], c[13],
              c[14] != 0, r1, NULL, u0, h, kind == 1 ? (long)(p[2] / h) + 4 : 1};
    int n = plant_states[kind] + (l.sample > 0 ? 0 : 2);
    double x[MAX_STATES] = {0}, scratch[2], y;
    l.past = calloc(l.size, sizeof(double));
    for (int i = 0; i < plant_states[kind]; i++) x[i] = x0[i];
    y = measured(&l, x);
    double transfer = l.Ki == 0 || l.sample <= 0 ? 0 : -l.Kp * l.b * (r0 - y);
    double integral = u0 - l.Kp * (l.b * r0 - y) - transfer, derivative = 0, previous = l.c * r0 - y, held = u0;
    if (l.sample <= 0) x[n - 2] = integral, x[n - 1] = previous;
    for (long k = 0; k < count * every; k++) {
        double t = k * h;
        if (l.sample > 0 && k % per_sample == 0) {
            double error, w, dither = l.offset + (l.analogue ? 0 : wave(&l, t));
            y = measured(&l, x), error = l.c * l.r - y;
            derivative = (l.Tf * derivative + l.Kd * (error - previous)) / (l.Tf + l.sample);
            integral += l.Ki * l.sample * (l.r - y);
            w = l.Kp * (l.b * l.r - y) + integral + derivative + transfer + dither;
            held = clip(&l, w);
            if (l.Ki == 0) integral *= l.Tt / (l.Tt + l.sample);
            else if (l.limited) integral += l.sample / l.Tt * (held - w);
            transfer *= l.Tt / (l.Tt + l.sample);
            previous = error;
        }
        if (k % every == 0) {
            long i = k / every;
            y = measured(&l, x);
            t_out[i] = t, y_out[i] = y, u_out[i] = command(&l, t, x, held, scratch);
            if (!isfinite(y) || (kind >= 3 && (x[0] < low || x[0] > high))) {
                free(l.past);
                return i;
            }
        }
        if (kind == 1) l.past[k % l.size] = command(&l, t, x, held, scratch);
        advance(&l, t, h, n, x, held);
    }
    free(l.past);
    return count;
}
