/* The PID servo with LuGre friction for many instances, as an expert writes it by hand with intrinsics: three vectors side by
   side, so that one does not wait for its own results; the exponential as range reduction and a polynomial, correct to an ulp;
   reciprocals of parameters computed once. It has no guards. AVX-512 where the compiler's target has it, else AVX2.

   Number s of instance k is at [s * WIDTH + k]. States and parameters are those of servo.c. */
#include <immintrin.h>
#include <stdint.h>

#define U 3
#define EACH(u) for (int u = 0; u < U; u++)
#define UNROLL _Pragma("GCC unroll 3")

#ifdef __AVX512F__
typedef __m512d V;
enum { LANES = 8 };
#define SET(x) _mm512_set1_pd(x)
#define FMA(a, b, c) _mm512_fmadd_pd(a, b, c)
#define FNMA(a, b, c) _mm512_fnmadd_pd(a, b, c)
#define LOAD(p) _mm512_loadu_pd(p)
#define STORE(p, v) _mm512_storeu_pd(p, v)
#define MIN(a, b) _mm512_min_pd(a, b)
#define MAX(a, b) _mm512_max_pd(a, b)
#define ABS(a) _mm512_abs_pd(a)
#define ROUND(a) _mm512_roundscale_pd(a, 0)
#define SCALE(a, n) _mm512_scalef_pd(a, n)
#else
typedef __m256d V;
enum { LANES = 4 };
#define SET(x) _mm256_set1_pd(x)
#define FMA(a, b, c) _mm256_fmadd_pd(a, b, c)
#define FNMA(a, b, c) _mm256_fnmadd_pd(a, b, c)
#define LOAD(p) _mm256_loadu_pd(p)
#define STORE(p, v) _mm256_storeu_pd(p, v)
#define MIN(a, b) _mm256_min_pd(a, b)
#define MAX(a, b) _mm256_max_pd(a, b)
#define ABS(a) _mm256_andnot_pd(_mm256_set1_pd(-0.0), a)
#define ROUND(a) _mm256_round_pd(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)
/* a 2^n for -1022 <= n <= 0: the sum puts n + 1023 into the low bits, the shift into the exponent. */
static inline V scale(V a, V n) {
    __m256i bits = _mm256_castpd_si256(_mm256_add_pd(n, _mm256_set1_pd(0x1.8p52 + 1023)));
    return _mm256_mul_pd(a, _mm256_castsi256_pd(_mm256_slli_epi64(bits, 52)));
}
#define SCALE(a, n) scale(a, n)
#endif

enum { WIDTH = U * LANES };
enum { R, M, SIGMA0, SIGMA1, SIGMA2, FC, FS, VS, KP, TI, TD, N, TT, U_MAX };

uint64_t lanes_width(void) { return WIDTH; }

/* exp(x) of x <= 0; below -708 it is exp(-708), which is nothing beside 1. */
static inline void exponential(V x[U]) {
    static const double of[] = {1.0 / 479001600, 1.0 / 39916800, 1.0 / 3628800, 1.0 / 362880, 1.0 / 40320, 1.0 / 5040,
                                1.0 / 720,       1.0 / 120,      1.0 / 24,      1.0 / 6,      0.5,         1.0, 1.0};
    V n[U], t[U], p[U];
    UNROLL EACH(u) x[u] = MAX(x[u], SET(-708.0));
    UNROLL EACH(u) n[u] = ROUND(x[u] * SET(1.4426950408889634));
    UNROLL EACH(u) t[u] = FNMA(n[u], SET(0x1.62e42fefa3800p-1), x[u]);
    UNROLL EACH(u) t[u] = FNMA(n[u], SET(0x1.ef35793c76730p-45), t[u]);
    UNROLL EACH(u) p[u] = SET(of[0]);
    _Pragma("GCC unroll 12") for (int k = 1; k < 13; k++) UNROLL EACH(u) p[u] = FMA(p[u], t[u], SET(of[k]));
    UNROLL EACH(u) x[u] = SCALE(p[u], n[u]);
}

typedef struct {
    V x[5][U];
} States;

#define P(s) LOAD(p + (s) * WIDTH + u * LANES)
#define Q(s) LOAD(q + (s) * WIDTH + u * LANES)

/* Slopes. q: what is computed once: 1/m, 1/vs, Kp/Ti, 1/Tt, N/Td, Kp N, Fs - Fc. */
static inline void derivatives(const double *p, const double *q, const States *s, States *d) {
    V e[U], raw[U], u_[U], g[U];
    UNROLL EACH(u) {
        V ratio = s->x[1][u] * Q(1);
        g[u] = FNMA(ratio, ratio, SET(0.0));
    }
    exponential(g);
    UNROLL EACH(u) {
        g[u] = FMA(Q(6), g[u], P(FC));
        e[u] = P(R) - s->x[0][u];
        V moved = s->x[0][u] - s->x[4][u];
        raw[u] = FNMA(Q(5), moved, FMA(P(KP), e[u], s->x[3][u]));
        u_[u] = MAX(MIN(raw[u], P(U_MAX)), SET(0.0) - P(U_MAX));
        d->x[4][u] = Q(4) * moved;
    }
    UNROLL EACH(u) {
        V v = s->x[1][u], z = s->x[2][u];
        V rate = FNMA(P(SIGMA0) * ABS(v) / g[u], z, v);
        V force = FMA(P(SIGMA0), z, FMA(P(SIGMA1), rate, P(SIGMA2) * v));
        d->x[0][u] = v;
        d->x[1][u] = (u_[u] - force) * Q(0);
        d->x[2][u] = rate;
        d->x[3][u] = FMA(Q(2), e[u], (u_[u] - raw[u]) * Q(3));
    }
}

static void once(const double *p, double *q) {
    for (int k = 0; k < WIDTH; k++) {
        const double *of = p + k;
        q[k] = 1 / of[M * WIDTH];
        q[WIDTH + k] = 1 / of[VS * WIDTH];
        q[2 * WIDTH + k] = of[KP * WIDTH] / of[TI * WIDTH];
        q[3 * WIDTH + k] = 1 / of[TT * WIDTH];
        q[4 * WIDTH + k] = of[N * WIDTH] / of[TD * WIDTH];
        q[5 * WIDTH + k] = of[KP * WIDTH] * of[N * WIDTH];
        q[6 * WIDTH + k] = of[FS * WIDTH] - of[FC * WIDTH];
    }
}

static inline void moved(States *to, const States *from, V h, const States *d) {
    _Pragma("GCC unroll 5") for (int i = 0; i < 5; i++) UNROLL EACH(u) to->x[i][u] = FMA(h, d->x[i][u], from->x[i][u]);
}

static inline void load(States *s, const double *state) {
    for (int i = 0; i < 5; i++) EACH(u) s->x[i][u] = LOAD(state + i * WIDTH + u * LANES);
}

static inline void store(const States *s, double *state) {
    for (int i = 0; i < 5; i++) EACH(u) STORE(state + i * WIDTH + u * LANES, s->x[i][u]);
}

void euler_lanes(double *state, const double *p, double h, uint64_t count) {
    double q[7 * WIDTH];
    once(p, q);
    States s, d;
    load(&s, state);
    for (uint64_t n = 0; n < count; n++) {
        derivatives(p, q, &s, &d);
        moved(&s, &s, SET(h), &d);
    }
    store(&s, state);
}

void rk4_lanes(double *state, const double *p, double h, uint64_t count) {
    double q[7 * WIDTH];
    once(p, q);
    States s, y, d, sum;
    load(&s, state);
    for (uint64_t n = 0; n < count; n++) {
        derivatives(p, q, &s, &sum);
        moved(&y, &s, SET(h / 2), &sum);
        derivatives(p, q, &y, &d);
        moved(&sum, &sum, SET(2.0), &d);
        moved(&y, &s, SET(h / 2), &d);
        derivatives(p, q, &y, &d);
        moved(&sum, &sum, SET(2.0), &d);
        moved(&y, &s, SET(h), &d);
        derivatives(p, q, &y, &d);
        moved(&sum, &sum, SET(1.0), &d);
        moved(&s, &s, SET(h / 6), &sum);
    }
    store(&s, state);
}
