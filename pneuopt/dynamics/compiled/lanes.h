/* A double in each SIMD lane, and the functions of an SX graph on it; LANES = 1 is a plain double.

   GCC's vector extensions, which clang shares: the operators work lane by lane, a comparison gives a mask. A lane never
   reaches another one, so that a NaN stays where it is. Errors in units of the last place: exp 1.1, tanh 3; sin 2e-16. */

#include <math.h>
#include <string.h>

#ifndef LANES
/* 8 under AVX-512 took 1.2 to 1.6 times as long as 4 (gcc 12); gcc aligns no wide vectors on Windows (its bug 54412) */
#if defined(__AVX__) && !defined(_WIN32)
#define LANES 4
#else
#define LANES 2
#endif
#endif

#if LANES > 1

typedef double Lanes __attribute__((vector_size(8 * LANES)));
typedef long long Mask __attribute__((vector_size(8 * LANES)));

#define ALL(a) ((a) + (Lanes){0})
#define BITS(a) ((a) + (Mask){0})
#define GET(v, lane) ((v)[lane])
#define PUT(v, lane, a) ((v)[lane] = (a))

static inline Lanes choose(Mask m, Lanes a, Lanes b) { return (Lanes)((m & (Mask)a) | (~m & (Mask)b)); }
static inline Lanes truth(Mask m) { return (Lanes)(m & (Mask)ALL(1.0)); }

#define EACH(name)                                         \
  static inline Lanes v_##name(Lanes a) {                  \
    for (int i = 0; i < LANES; i++) a[i] = name(a[i]);     \
    return a;                                              \
  }
#define EACH2(name)                                        \
  static inline Lanes v_##name(Lanes a, Lanes b) {         \
    for (int i = 0; i < LANES; i++) a[i] = name(a[i], b[i]); \
    return a;                                              \
  }

#define SIGN_BIT BITS(-0x7fffffffffffffffLL - 1)
static inline Lanes v_fabs(Lanes a) { return (Lanes)((Mask)a & ~SIGN_BIT); }
static inline Lanes v_copysign(Lanes a, Lanes b) { return (Lanes)(((Mask)a & ~SIGN_BIT) | ((Mask)b & SIGN_BIT)); }
static inline Lanes v_sign(Lanes a) { return choose((a > 0) | (a < 0), v_copysign(ALL(1.0), a), a); }
static inline Lanes v_fmin(Lanes a, Lanes b) { return choose((a < b) | (b != b), a, b); }
static inline Lanes v_fmax(Lanes a, Lanes b) { return choose((a > b) | (b != b), a, b); }
static inline Lanes v_lt(Lanes a, Lanes b) { return truth(a < b); }
static inline Lanes v_le(Lanes a, Lanes b) { return truth(a <= b); }
static inline Lanes v_eq(Lanes a, Lanes b) { return truth(a == b); }
static inline Lanes v_ne(Lanes a, Lanes b) { return truth(a != b); }
static inline Lanes v_not(Lanes a) { return truth(a == 0); }
static inline Lanes v_and(Lanes a, Lanes b) { return truth((a != 0) & (b != 0)); }
static inline Lanes v_or(Lanes a, Lanes b) { return truth((a != 0) | (b != 0)); }
static inline Lanes v_if_else_zero(Lanes a, Lanes b) { return (Lanes)((a != 0) & (Mask)b); }

/* 1.5 * 2^52: a smaller number that is added to it is rounded to a whole one, which stands in its last bits */
#define WHOLE 6755399441055744.0
static inline Lanes nearest(Lanes a) { return (a + ALL(WHOLE)) - ALL(WHOLE); }

/* 2^k for a whole -1022 <= k <= 1023 */
static inline Lanes power_of_two(Lanes k) { return (Lanes)(((Mask)(k + ALL(WHOLE)) << 52) + (Mask)ALL(1.0)); }

/* e^r - 1 for |r| <= ln(2)/2, by its series up to r^13, even and odd terms apart */
static inline Lanes short_expm1(Lanes r) {
  Lanes q = r * r, even, odd;
  even = 1.0 / 479001600 + ALL(0.0);
  odd = 1.0 / 6227020800 + ALL(0.0);
  even = even * q + 1.0 / 3628800, odd = odd * q + 1.0 / 39916800;
  even = even * q + 1.0 / 40320, odd = odd * q + 1.0 / 362880;
  even = even * q + 1.0 / 720, odd = odd * q + 1.0 / 5040;
  even = even * q + 1.0 / 24, odd = odd * q + 1.0 / 120;
  even = even * q + 0.5, odd = odd * q + 1.0 / 6;
  return r + q * (even + r * odd);
}

/* a = k ln 2 + r with a whole k; ln 2 in two parts, of which k times the first is exact */
static inline Lanes reduced(Lanes a, Lanes k) { return (a - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10; }
#define LOG2_E 1.44269504088896338700

static inline Lanes v_exp(Lanes a) {
  a = choose(a > 720, ALL(720.0), choose(a < -760, ALL(-760.0), a)); /* beyond the range of doubles, a NaN stays */
  Lanes k = nearest(a * LOG2_E), half = nearest(0.5 * k);
  return (1 + short_expm1(reduced(a, k))) * power_of_two(half) * power_of_two(k - half);
}

/* tanh a = m / (m + 2) with m = e^(2|a|) - 1, without cancellation near 0; 1 from 20 on */
static inline Lanes v_tanh(Lanes a) {
  Lanes b = 2 * v_fabs(a);
  b = choose(b > 40, ALL(40.0), b);
  Lanes k = nearest(b * LOG2_E), two_k = power_of_two(k);
  Lanes m = two_k * short_expm1(reduced(b, k)) + (two_k - 1);
  return v_copysign(m / (m + 2), a);
}

/* sin a = (-1)^k sin r with a = k pi + r, pi in three parts of which k times the first two are exact; its series up to
   r^21. A lane beyond a million radians, or that is no number, gets the C library's own, and only that lane. */
static inline Lanes v_sin(Lanes a) {
  Lanes shifted = a * 3.18309886183790671538e-01 + ALL(WHOLE), k = shifted - ALL(WHOLE);
  Lanes r = ((a - k * 3.14159250259399414062e+00) - k * 1.50995788317231927068e-07) - k * 1.07806057163162381058e-14;
  Lanes q = r * r, w = q * q, even, odd; /* the factors of q, q^3, .. and of q^2, q^4, .. */
  odd = 1.0 / 121645100408832000.0 * ALL(-1.0), even = 1.0 / 51090942171709440000.0 + ALL(0.0);
  odd = odd * w - 1.0 / 1307674368000.0, even = even * w + 1.0 / 355687428096000.0;
  odd = odd * w - 1.0 / 39916800.0, even = even * w + 1.0 / 6227020800.0;
  odd = odd * w - 1.0 / 5040.0, even = even * w + 1.0 / 362880.0;
  odd = odd * w - 1.0 / 6.0, even = even * w + 1.0 / 120.0;
  r = r + r * q * (odd + q * even);
  r = (Lanes)((Mask)r ^ ((Mask)shifted << 63));
  for (int i = 0; i < LANES; i++)
    if (!(fabs(a[i]) < 1e6)) r[i] = sin(a[i]);
  return r;
}

#else

typedef double Lanes;
#define ALL(a) ((double)(a))
#define GET(v, lane) (v)
#define PUT(v, lane, a) ((v) = (a))
#define EACH(name) static inline double v_##name(double a) { return name(a); }
#define EACH2(name) static inline double v_##name(double a, double b) { return name(a, b); }
EACH(fabs) EACH(exp) EACH(tanh) EACH(sin) EACH2(copysign) EACH2(fmin) EACH2(fmax)
static inline double v_sign(double a) { return a > 0 ? 1 : a < 0 ? -1 : a; }
static inline double v_lt(double a, double b) { return a < b; }
static inline double v_le(double a, double b) { return a <= b; }
static inline double v_eq(double a, double b) { return a == b; }
static inline double v_ne(double a, double b) { return a != b; }
static inline double v_not(double a) { return !a; }
static inline double v_and(double a, double b) { return a && b; }
static inline double v_or(double a, double b) { return a || b; }
static inline double v_if_else_zero(double a, double b) { return a ? b : 0; }

#endif

EACH(sqrt) EACH(log) EACH(log1p) EACH(expm1) EACH(cos) EACH(tan) EACH(asin) EACH(acos) EACH(atan) EACH(sinh) EACH(cosh)
EACH(asinh) EACH(acosh) EACH(atanh) EACH(erf) EACH(floor) EACH(ceil)
EACH2(pow) EACH2(atan2) EACH2(hypot) EACH2(fmod)
