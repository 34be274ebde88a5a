/* Two loops with LuGre friction for the C programs beside: rates, Jacobian (row-major) and its derivative along time; and
 * how they are timed. -DHUNTING chooses the loop. */
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { INSTANTS = 200 };

static const double sigma0 = 1e5, sigma1 = 316.22776601683796;
/* By how much the force at rest is above the sliding one, in N: a sweep varies it. */
static double rise = 0.5;

#if HUNTING
enum { N = 4 };
static const double end = 100.0;
static const double scale[N] = {1, 1, 1e-6, 1};
static void rates(double t, const double *x, double *f) {
    (void)t;
    double v = x[1], q = v / 1e-3, g = 1 + rise * exp(-q * q), dz = v - sigma0 * fabs(v) / g * x[2];
    f[0] = v;
    f[1] = 3 * (1 - x[0]) + x[3] - 6 * v - (sigma0 * x[2] + sigma1 * dz + 0.4 * v);
    f[2] = dz;
    f[3] = 4 * (1 - x[0]);
}
static void jacobian(double t, const double *x, double *j, double *ft) {
    (void)t;
    double v = x[1], q = v / 1e-3, e = rise * exp(-q * q), g = 1 + e, k = sigma0 * fabs(v) / g;
    double dk = sigma0 * (v < 0 ? -1 : 1) / g + k / g * e * 2 * q / 1e-3, zv = 1 - dk * x[2];
    double m[16] = {0, 1, 0, 0, -3, -6.4 - sigma1 * zv, -sigma0 + sigma1 * k, 1, 0, zv, -k, 0, -4, 0, 0, 0};
    memcpy(j, m, sizeof m);
    memset(ft, 0, N * sizeof *ft);
}
#else
enum { N = 3 };
static const double end = 20.0;
static const double scale[N] = {1, 1, 1e-6};
static void rates(double t, const double *x, double *f) {
    double v = x[1], q = v / 1e-3, g = 1 + rise * exp(-q * q), dz = v - sigma0 * fabs(v) / g * x[2];
    f[0] = v;
    f[1] = 2 * (0.1 * t - x[0]) - (sigma0 * x[2] + sigma1 * dz + 0.4 * v);
    f[2] = dz;
}
static void jacobian(double t, const double *x, double *j, double *ft) {
    (void)t;
    double v = x[1], q = v / 1e-3, e = rise * exp(-q * q), g = 1 + e, k = sigma0 * fabs(v) / g;
    double dk = sigma0 * (v < 0 ? -1 : 1) / g + k / g * e * 2 * q / 1e-3, zv = 1 - dk * x[2];
    double m[9] = {0, 1, 0, -2, -0.4 - sigma1 * zv, -sigma0 + sigma1 * k, 0, zv, -k};
    memcpy(j, m, sizeof m);
    ft[0] = 0, ft[1] = 0.2, ft[2] = 0;
}
#endif

/* Positions at the instants, unless there is no room for them; gives the last one. */
static double run(double tol, double *positions);

static double processor_time(void) {
    struct timespec now;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

/* TOL RUNS sweep: one run after the other, each with another rise; prints the processor time of a run in s, then the last
 * position of each. */
static int sweep(double tol, int runs) {
    double *last = malloc(runs * sizeof *last), begin = processor_time();
    for (int k = 0; k < runs; k++) {
        rise = 0.5 * (0.9 + 0.2 * k / runs);
        last[k] = run(tol, NULL);
    }
    printf("%.9e\n", (processor_time() - begin) / runs);
    for (int k = 0; k < runs; k++) printf("%.17g\n", last[k]);
    free(last);
    return 0;
}

/* TOL ROUNDS: prints the least processor time of a run in s, then the position at 201 instants. */
int main(int count, char **args) {
    if (count == 4) return sweep(atof(args[1]), atoi(args[2]));
    if (count != 3) return 2;
    double tol = atof(args[1]), positions[INSTANTS + 1], least = INFINITY;
    for (int k = 0; k < atoi(args[2]); k++) {
        double begin = processor_time();
        run(tol, positions);
        least = fmin(least, processor_time() - begin);
    }
    printf("%.9e\n", least);
    for (int k = 0; k <= INSTANTS; k++) printf("%.17g\n", positions[k]);
    return 0;
}
