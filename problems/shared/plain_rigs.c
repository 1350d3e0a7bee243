/* Rigs of foreign_rigs.py in plain C, which shares no line with pneuopt: a force drive and a pneumatic cylinder, each
   under a sampled controller. Classical Runge-Kutta in fixed steps; true stiction is a mode of its own: the mass stands
   until the force on it exceeds the static level, and slides until its speed changes its sign, at an instant that is
   interpolated. Flow by ISO 6358-1:2013, of air of 1.185 kg/m^3 at its reference, and the edges are sharp. */
#include <math.h>
#include <string.h>

enum { SMOOTH, STICKING, LUGRE };
enum { FORCE_DRIVE, CYLINDER };

typedef struct {
    double kind, friction;
    double mass, load, coulomb, stat, stribeck, viscous, smoothing, bristle, bristle_damping, damping_velocity;
    double area_a, area_b, stroke, dead_a, dead_b, supply, ambient, temperature, gas, exponent;
    double conductance, ratio, dead_zone, leak, span, corner, order, spool_damping;
    double gain, damping, limit, sample, step;
} Rig;

enum { X, V, PA, PB, S, SR, Z, STATES };

static double clip(double v, double low, double high) { return v < low ? low : v > high ? high : v; }

static double stribeck_level(const Rig *r, double v) {
    double e = v / r->stribeck;
    return r->coulomb + (r->stat - r->coulomb) * exp(-e * e);
}

static double flow(const Rig *r, double up, double down, double opening) {
    double sign = 1.0;
    if (down > up) { double t = up; up = down; down = t; sign = -1.0; }
    double ratio = down / up, part = 1.0;
    if (ratio > r->ratio) { double q = (ratio - r->ratio) / (1.0 - r->ratio); part = sqrt(fmax(0.0, 1.0 - q * q)); }
    return sign * r->conductance * opening * 1.185 * sqrt(293.15 / r->temperature) * up * part;
}

static double edge(const Rig *r, double x) { return fmax(0.0, x - r->dead_zone) + r->leak; }

static double push(const Rig *r, const double *x, double u) {
    if (r->kind == FORCE_DRIVE) return u - r->load;
    return r->area_a * (x[PA] - r->ambient) - r->area_b * (x[PB] - r->ambient) - r->load;
}

/* mode: -1, 1 sliding, 0 standing; 2: friction is a function of the speed */
static void rates(const Rig *r, const double *x, double u, int mode, double *d) {
    double v = mode == 0 ? 0.0 : x[V], f = 0.0;
    memset(d, 0, STATES * sizeof(double));
    if (r->friction == SMOOTH) f = stribeck_level(r, v) * tanh(v / r->smoothing) + r->viscous * v;
    if (r->friction == STICKING) f = mode * stribeck_level(r, v) + r->viscous * v;
    if (r->friction == LUGRE) {
        double dz = v - r->bristle * fabs(v) * x[Z] / stribeck_level(r, v), e = v / r->damping_velocity;
        f = r->bristle * x[Z] + r->bristle_damping * exp(-e * e) * dz + r->viscous * v;
        d[Z] = dz;
    }
    d[X] = v;
    d[V] = mode == 0 ? 0.0 : (push(r, x, u) - f) / r->mass;
    if (r->kind == FORCE_DRIVE) return;
    double command = clip(u / r->span, -1.0, 1.0), s = r->order == 0 ? command : x[S];
    if (r->order == 1) d[S] = r->corner * (command - x[S]);
    if (r->order == 2) {
        d[S] = x[SR];
        d[SR] = r->corner * r->corner * (command - x[S]) - 2 * r->spool_damping * r->corner * x[SR];
    }
    double wa = flow(r, r->supply, x[PA], edge(r, s)) - flow(r, x[PA], r->ambient, edge(r, -s));
    double wb = flow(r, r->supply, x[PB], edge(r, -s)) - flow(r, x[PB], r->ambient, edge(r, s));
    double heat = r->exponent * r->gas * r->temperature;
    d[PA] = (heat * wa - r->exponent * x[PA] * r->area_a * v) / (r->dead_a + r->area_a * x[X]);
    d[PB] = (heat * wb + r->exponent * x[PB] * r->area_b * v) / (r->dead_b + r->area_b * (r->stroke - x[X]));
}

static void advance(const Rig *r, double *x, double u, int mode, double h) {
    double k[4][STATES], y[STATES];
    static const double at[4] = {0.0, 0.5, 0.5, 1.0};
    for (int i = 0; i < 4; i++) {
        for (int j = 0; j < STATES; j++) y[j] = x[j] + (i ? at[i] * h * k[i - 1][j] : 0.0);
        rates(r, y, u, mode, k[i]);
    }
    for (int j = 0; j < STATES; j++) x[j] += h / 6 * (k[0][j] + 2 * k[1][j] + 2 * k[2][j] + k[3][j]);
}

static void run(const Rig *r, double *x, double u, int *mode, double h) {
    if (r->friction != STICKING) { advance(r, x, u, 2, h); return; }
    double left = h;
    for (int tries = 0; left > 1e-12 && tries < 8; tries++) {
        if (*mode == 0) {
            double f = push(r, x, u);
            if (fabs(f) > r->stat) *mode = f > 0 ? 1 : -1;
        }
        double before[STATES];
        memcpy(before, x, sizeof before);
        advance(r, x, u, *mode, left);
        if (*mode == 0 || x[V] * *mode >= 0) return;
        double part = left * before[V] / (before[V] - x[V]);
        memcpy(x, before, sizeof before);
        if (part > 0) advance(r, x, u, *mode, part);
        x[V] = 0.0, *mode = 0, left -= fmax(part, 0.0);
    }
}

/* wanted: n references (position), or commands where the gain is 0; out: n rows of position, speed, both pressures, the
   command that holds until the next row. Returns the rows, fewer where the piston has come to its covers. */
int simulate(const Rig *r, const double *start, int n, const double *wanted, double *out) {
    double x[STATES];
    int mode = 0, steps = (int)ceil(r->sample / r->step);
    memcpy(x, start, sizeof x);
    for (int k = 0; k < n; k++) {
        double u = wanted[k];
        if (r->gain) u = r->gain * (wanted[k] - x[X]) - r->damping * x[V];
        u = clip(u, -r->limit, r->limit);
        double row[5] = {x[X], x[V], x[PA], x[PB], u};
        memcpy(out + 5 * k, row, sizeof row);
        for (int i = 0; i < steps; i++) run(r, x, u, &mode, r->sample / steps);
        int outside = r->kind == CYLINDER && (x[X] < 0.01 * r->stroke || x[X] > 0.99 * r->stroke);
        if (outside || !isfinite(x[X])) return k + 1;
    }
    return n;
}
