/* The PID servo with LuGre friction as one would write it by hand: what generated code is measured against.
   States: position, velocity, bristle deflection, integral part, filtered measurement. */
#include <math.h>
#include <stdint.h>

typedef struct {
    double r, m, sigma0, sigma1, sigma2, Fc, Fs, vs, Kp, Ti, Td, N, Tt, u_max;
} Params;

static inline void derivatives(const Params *p, const double x[5], double dx[5]) {
    double e = p->r - x[0];
    double raw = p->Kp * e + x[3] - p->Kp * p->N * (x[0] - x[4]);
    double u = raw < -p->u_max ? -p->u_max : raw > p->u_max ? p->u_max : raw;
    double ratio = x[1] / p->vs;
    double g = p->Fc + (p->Fs - p->Fc) * exp(-(ratio * ratio));
    double dz = x[1] - p->sigma0 * fabs(x[1]) / g * x[2];
    double F = p->sigma0 * x[2] + p->sigma1 * dz + p->sigma2 * x[1];
    dx[0] = x[1];
    dx[1] = (u - F) / p->m;
    dx[2] = dz;
    dx[3] = p->Kp / p->Ti * e + (u - raw) / p->Tt;
    dx[4] = p->N / p->Td * (x[0] - x[4]);
}

void euler(double *state, const Params *params, double h, uint64_t count) {
    Params p = *params;
    double x[5], dx[5];
    for (int i = 0; i < 5; i++) x[i] = state[i];
    for (uint64_t n = 0; n < count; n++) {
        derivatives(&p, x, dx);
        for (int i = 0; i < 5; i++) x[i] += h * dx[i];
    }
    for (int i = 0; i < 5; i++) state[i] = x[i];
}

static inline void rk4_step(const Params *p, double x[5], double h) {
    double y[5], k1[5], k2[5], k3[5], k4[5];
    derivatives(p, x, k1);
    for (int i = 0; i < 5; i++) y[i] = x[i] + h / 2 * k1[i];
    derivatives(p, y, k2);
    for (int i = 0; i < 5; i++) y[i] = x[i] + h / 2 * k2[i];
    derivatives(p, y, k3);
    for (int i = 0; i < 5; i++) y[i] = x[i] + h * k3[i];
    derivatives(p, y, k4);
    for (int i = 0; i < 5; i++) x[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
}

void rk4(double *state, const Params *params, double h, uint64_t count) {
    Params p = *params;
    double x[5];
    for (int i = 0; i < 5; i++) x[i] = state[i];
    for (uint64_t n = 0; n < count; n++) {
        rk4_step(&p, x, h);
    }
    for (int i = 0; i < 5; i++) state[i] = x[i];
}

/* The friction force of these states. */
static inline double force(const Params *p, const double x[5]) {
    double ratio = x[1] / p->vs;
    double g = p->Fc + (p->Fs - p->Fc) * exp(-(ratio * ratio));
    double dz = x[1] - p->sigma0 * fabs(x[1]) / g * x[2];
    return p->sigma0 * x[2] + p->sigma1 * dz + p->sigma2 * x[1];
}

/* The same with the friction force after every step, as a sixth number: somebody reads it there. */
void euler_force(double *state, const Params *params, double h, uint64_t count) {
    Params p = *params;
    double x[5], dx[5];
    volatile double *F = state + 5;
    for (int i = 0; i < 5; i++) x[i] = state[i];
    for (uint64_t n = 0; n < count; n++) {
        derivatives(&p, x, dx);
        for (int i = 0; i < 5; i++) x[i] += h * dx[i];
        *F = force(&p, x);
    }
    for (int i = 0; i < 5; i++) state[i] = x[i];
}

void rk4_force(double *state, const Params *params, double h, uint64_t count) {
    volatile double *F = state + 5;
    Params p = *params;
    double x[5];
    for (int i = 0; i < 5; i++) x[i] = state[i];
    for (uint64_t n = 0; n < count; n++) {
        rk4_step(&p, x, h);
        *F = force(&p, x);
    }
    for (int i = 0; i < 5; i++) state[i] = x[i];
}

/* The contact alone, its speed prescribed: a sine of 10 mm/s and 1 Hz. States: bristle deflection, number of steps. */
void contact(double *state, const Params *params, double h, uint64_t count) {
    Params p = *params;
    double z = state[0], first = state[1];
    for (uint64_t n = 0; n < count; n++) {
        double v = 0.01 * sin(6.283185307179586 * ((first + (double)n) * h));
        double ratio = v / p.vs;
        double g = p.Fc + (p.Fs - p.Fc) * exp(-(ratio * ratio));
        z += h * (v - p.sigma0 * fabs(v) / g * z);
    }
    state[0] = z;
    state[1] = first + (double)count;
}

/* The contact alone with a speed for each step from an array, and the friction force after each step to another one. */
static inline double rate(double v, double a, double z) {
    return v - a * z;
}

static inline double steady(const Params *p, double v) {
    double ratio = v / p->vs;
    return p->sigma0 * fabs(v) / (p->Fc + (p->Fs - p->Fc) * exp(-(ratio * ratio)));
}

void contact_euler(double *state, const Params *params, double h, uint64_t count, const double *v, double *F) {
    Params p = *params;
    double z = *state;
    for (uint64_t n = 0; n < count; n++) {
        double a = steady(&p, v[n]);
        z += h * rate(v[n], a, z);
        F[n] = p.sigma0 * z + p.sigma1 * rate(v[n], a, z) + p.sigma2 * v[n];
    }
    *state = z;
}

void contact_rk4(double *state, const Params *params, double h, uint64_t count, const double *v, double *F) {
    Params p = *params;
    double z = *state;
    for (uint64_t n = 0; n < count; n++) {
        double a = steady(&p, v[n]);
        double k1 = rate(v[n], a, z);
        double k2 = rate(v[n], a, z + h / 2 * k1);
        double k3 = rate(v[n], a, z + h / 2 * k2);
        double k4 = rate(v[n], a, z + h * k3);
        z += h / 6 * (k1 + 2 * (k2 + k3) + k4);
        F[n] = p.sigma0 * z + p.sigma1 * rate(v[n], a, z) + p.sigma2 * v[n];
    }
    *state = z;
}
