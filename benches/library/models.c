/* Models of the library as one writes them by hand for a controller: one fixed step of a function that is called through
 * a pointer, with libm. States that relax are stepped exactly along their own exponential, where others enter with their
 * mean over the step (the library's `expo`); what is linear in its own state needs no iteration for that.
 * The order in a step: states advance at held inputs; sampled parts that are due; transitions; outputs. */
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define ARGS double *restrict x, const double *restrict p, const double *restrict u, double *restrict o, double h
#define STATELESS (void)x, (void)h
#define UNUSED(what) (void)(what)

static inline double sgn(double v) { return (v > 0) - (v < 0); }
static inline double clamp(double x, double lo, double hi) { return x < lo ? lo : x > hi ? hi : x; }
static inline double sq(double x) { return x * x; }

/* (e^q - 1)/q */
static inline double phi(double q) { return q == 0 ? 1 : expm1(q) / q; }

/* (e^q - 1 - q)/q^2 */
static inline double phi2(double q) {
    if (q > -0.125) {
        double sum = 1.0 / 39916800;
        sum = sum * q + 1.0 / 3628800;
        sum = sum * q + 1.0 / 362880;
        sum = sum * q + 1.0 / 40320;
        sum = sum * q + 1.0 / 5040;
        sum = sum * q + 1.0 / 720;
        sum = sum * q + 1.0 / 120;
        sum = sum * q + 1.0 / 24;
        sum = sum * q + 1.0 / 6;
        return sum * q + 0.5;
    }
    return (expm1(q) / q - 1) / q;
}

/* dx/dt = f + a (x' - x) over one step: exact. */
static inline double relaxed(double x, double f, double a, double h) { return x + h * phi(h * a) * f; }
static inline double mean(double x, double f, double a, double h) { return x + h * phi2(h * a) * f; }

static inline double stribeck(double v, double Fc, double Fs, double vs, double shape) {
    return Fc + (Fs - Fc) * exp(-pow(fabs(v / vs), shape));
}
static inline double stribeck2(double v, double Fc, double Fs, double vs) { return Fc + (Fs - Fc) * exp(-sq(v / vs)); }
static inline double stribeck1(double v, double Fc, double Fs, double vs) { return Fc + (Fs - Fc) * exp(-fabs(v / vs)); }

/* ---- static laws ---- */

static void Ambrosio(ARGS) {
    STATELESS;
    o[0] = p[0] * clamp((fabs(u[0]) - p[1]) / (p[2] - p[1]), 0, 1) * sgn(u[0]);
}
static void Asymmetric(ARGS) {
    STATELESS;
    const double *side = u[0] >= 0 ? p + 1 : p + 5; /* Fc Fs vs Fv */
    o[0] = p[0] + stribeck2(u[0], side[0], side[1], side[2]) * sgn(u[0]) + side[3] * u[0];
}
static void BengisuAkay(ARGS) {
    STATELESS;
    double Fc = p[0], Fs = p[1], v0 = p[2], xi = p[3], a = fabs(u[0]), r = a / v0;
    o[0] = (r < 1 ? Fs * (1 - sq(r - 1)) : Fc + (Fs - Fc) * exp(-xi * (a - v0))) * sgn(u[0]);
}
static void BreakAwayTanh(ARGS) {
    STATELESS;
    double Fc = p[0], Fs = p[1], v = u[0], r = v / p[2], Fv = p[3];
    o[0] = 1.6487212707001282 * (Fs - Fc) * exp(-0.5 * r * r) * r + Fc * tanh(10 * r) + Fv * v;
}
static void BrownMcPhee(ARGS) {
    STATELESS;
    double v = u[0], Fn = u[1], mud = p[0], mus = p[1], r = v / p[2], muv = p[3], Nt = p[4];
    o[0] = Fn * (mud * tanh(4 * r) + (mus - mud) * r / sq(0.25 * r * r + 0.75)) + muv * v * tanh(4 * Fn / Nt);
}
static void Coulomb(ARGS) {
    STATELESS;
    o[0] = p[0] * sgn(u[0]);
}
static void CoulombViscous(ARGS) {
    STATELESS;
    o[0] = p[0] * sgn(u[0]) + p[1] * u[0];
}
static void GearM1(ARGS) {
    STATELESS;
    o[0] = p[0] * u[0] + p[1] * sgn(u[0]);
}
static void GearM2(ARGS) {
    STATELESS;
    double v = u[0], S = exp(-pow(fabs(v / p[3]), p[4]));
    o[0] = p[0] * v + (p[1] + p[2] * S) * sgn(v);
}
static void GearM3(ARGS) {
    STATELESS;
    o[0] = p[0] * u[0] + (p[1] + p[2] * fabs(u[1] - u[2])) * sgn(u[0]);
}
static void GearM4(ARGS) {
    STATELESS;
    double v = u[0], load = fabs(u[1] - u[2]), S = exp(-pow(fabs(v / p[5]), p[6]));
    o[0] = p[0] * v + (p[1] + p[2] * load + (p[3] + p[4] * load) * S) * sgn(v);
}
static void GearM5(ARGS) {
    STATELESS;
    double v = u[0], Fm = u[1], Fe = u[2], S = exp(-pow(fabs(v / p[7]), p[8]));
    double dry = p[1] + fabs(p[2] * Fm - p[3] * Fe) + S * (p[4] + fabs(p[5] * Fm - p[6] * Fe));
    o[0] = p[0] * v + dry * sgn(v);
}
static void GearM6(ARGS) {
    STATELESS;
    double v = u[0], Fm = u[1], Fe = u[2], S = exp(-pow(fabs(v / p[9]), p[10]));
    double Q = fabs(Fm) > fabs(Fe) ? p[7] * Fe * Fe : p[8] * Fm * Fm;
    double dry = p[1] + fabs(p[2] * Fm - p[3] * Fe) + S * (p[4] + fabs(p[5] * Fm - p[6] * Fe) + Q);
    o[0] = p[0] * v + dry * sgn(v);
}
static void KFMSmooth(ARGS) {
    STATELESS;
    double v = u[0];
    o[0] = stribeck2(v, p[0], p[1], p[4]) * tanh(v / p[3]) + p[2] * v;
}
static void HyperbolicAgeing(ARGS) {
    STATELESS;
    o[0] = u[0] / (u[0] + p[0]);
}
static void ExponentialAgeing(ARGS) {
    STATELESS;
    o[0] = 1 - exp(-pow(u[0] / p[0], p[1]));
}
static void Makkar(ARGS) {
    STATELESS;
    double v = u[0];
    o[0] = p[0] * (tanh(p[1] * v) - tanh(p[2] * v)) + p[3] * tanh(p[4] * v) + p[5] * v;
}
static void PointsFriction(ARGS) {
    STATELESS;
    double a = fabs(u[0]), v1 = p[1], F1 = p[2], v2 = p[3], F2 = p[4], v3 = p[5], F3 = p[6], v4 = p[7], F4 = p[8], F;
    if (a < v1)
        F = p[0] + (F1 - p[0]) * (a / v1);
    else if (a < v2)
        F = F1 + (F2 - F1) * ((a - v1) / (v2 - v1));
    else if (a < v3)
        F = F2 + (F3 - F2) * ((a - v2) / (v3 - v2));
    else
        F = F3 + (F4 - F3) * ((a - v3) / (v4 - v3));
    o[0] = F * sgn(u[0]);
}
static void TanhSign(ARGS) {
    STATELESS;
    UNUSED(p);
    o[0] = tanh(u[0] / u[1]);
}
static void AtanSign(ARGS) {
    STATELESS;
    UNUSED(p);
    o[0] = 0.6366197723675814 * atan(u[0] / u[1]);
}
static void RootSign(ARGS) {
    STATELESS;
    UNUSED(p);
    o[0] = u[0] / sqrt(u[0] * u[0] + u[1] * u[1]);
}
static void ClampSign(ARGS) {
    STATELESS;
    UNUSED(p);
    o[0] = clamp(u[0] / u[1], -1, 1);
}
static void Smoothed(ARGS) {
    STATELESS;
    double v = u[0], v_law = v >= 0 ? fmax(v, p[1]) : fmin(v, -p[1]); /* v0 v_min; Fc Fs vs Fv of the law */
    o[0] = fabs(tanh(v / p[0])) * (stribeck2(v_law, p[2], p[3], p[4]) * sgn(v_law) + p[5] * v_law);
}
static void StribeckGauss(ARGS) {
    STATELESS;
    o[0] = stribeck2(u[0], p[0], p[1], p[2]) * sgn(u[0]) + p[3] * u[0];
}
static void StribeckLorentz(ARGS) {
    STATELESS;
    o[0] = (p[0] + (p[1] - p[0]) / (1 + sq(u[0] / p[2]))) * sgn(u[0]) + p[3] * u[0];
}
static void BoPavelescu(ARGS) {
    STATELESS;
    o[0] = stribeck(u[0], p[0], p[1], p[2], p[3]) * sgn(u[0]) + p[4] * u[0];
}
static void LoadedStribeck(ARGS) {
    STATELESS;
    o[0] = u[1] * stribeck2(u[0], p[0], p[1], p[2]) * sgn(u[0]);
}
static void BittencourtGunnarsson(ARGS) {
    STATELESS;
    double v = u[0], load = fabs(u[1]), T = u[2];
    double dry = p[0] + p[1] * load + (p[2] + p[3] * T) * exp(-pow(fabs(v / (p[5] + p[6] * T)), 1.3))
                 + p[4] * load * exp(-pow(fabs(v / p[7]), 1.3));
    o[0] = dry * sgn(v) + (p[8] + p[9] * exp(-T / p[10])) * v;
}
static void Threlfall(ARGS) {
    STATELESS;
    o[0] = p[0] * (1 - exp(-3 * fmin(fabs(u[0]) / p[1], 1))) * sgn(u[0]);
}
static void Tustin(ARGS) {
    STATELESS;
    o[0] = stribeck1(u[0], p[0], p[1], p[2]) * sgn(u[0]) + p[3] * u[0];
}
static void Viscous(ARGS) {
    STATELESS;
    o[0] = p[0] * u[0];
}
static void ViscousPowers(ARGS) {
    STATELESS;
    double v = u[0], a = fabs(v);
    o[0] = (p[0] + p[1] * sqrt(a / p[2])) * sgn(v) + p[3] * v + p[4] * v * a;
}

/* Cubics through measured points; slopes after Fritsch and Butland, worked out beforehand. */
static void TableFriction(ARGS) {
    STATELESS;
    static const double at[7] = {0, 0.5e-3, 1e-3, 2e-3, 5e-3, 0.1, 1};
    static const double F[7] = {1.5, 1.39, 1.184, 1.01, 1.002, 1.04, 1.4};
    static const double slope[7] = {-220.0000000000002, -286.8354430379748, -256.2319301032564, -6.265566391597906, 0.0, 0.4000000000000002, 0.39999999999999986};
    double a = fmin(fabs(u[0]), at[6]);
    int k = 0;
    while (k < 5 && at[k + 1] <= a)
        k++;
    double width = at[k + 1] - at[k], s = (a - at[k]) / width, rise = F[k + 1] - F[k];
    double m0 = slope[k] * width, m1 = slope[k + 1] * width;
    double y = F[k] + s * (m0 + s * (3 * rise - 2 * m0 - m1 + s * (m0 + m1 - 2 * rise)));
    o[0] = p[0] * y * sgn(u[0]);
}

/* ---- bristles that relax ---- */

static void LuGre(ARGS) {
    double v = u[0], s0 = p[0], g = stribeck2(v, p[3], p[4], p[5]), a = -s0 * fabs(v) / g;
    x[0] = relaxed(x[0], v + a * x[0], a, h);
    o[0] = s0 * x[0] + p[1] * exp(-sq(v / p[6])) * (v + a * x[0]) + p[2] * v;
}
static void LoadedLuGre(ARGS) {
    double v = u[0], s0 = p[0], g = stribeck2(v, p[3], p[4], p[5]), a = -s0 * fabs(v) / g;
    x[0] = relaxed(x[0], v + a * x[0], a, h);
    o[0] = u[1] * (s0 * x[0] + p[1] * exp(-sq(v / p[6])) * (v + a * x[0]) + p[2] * v);
}
static void LuGreAsymmetric(ARGS) {
    double v = u[0], s0 = p[0], Fc = v >= 0 ? p[3] : p[5], Fs = v >= 0 ? p[4] : p[6];
    double a = -s0 * fabs(v) / stribeck2(v, Fc, Fs, p[7]);
    x[0] = relaxed(x[0], v + a * x[0], a, h);
    o[0] = s0 * x[0] + p[1] * exp(-sq(v / p[8])) * (v + a * x[0]) + p[2] * v;
}
static void LuGreCurve(ARGS) {
    double v = u[0], s0 = p[0], v_law = v >= 0 ? fmax(v, p[4]) : fmin(v, -p[4]);
    double F = stribeck1(v_law, p[5], p[6], p[7]) * sgn(v_law) + p[8] * v_law;
    double a = -s0 * fabs(v) / fmax(fabs(F), p[3]);
    x[0] = relaxed(x[0], v + a * x[0], a, h);
    o[0] = s0 * x[0] + p[1] * exp(-sq(v / p[2])) * (v + a * x[0]);
}
static void LuGreObserver(ARGS) {
    double v = u[0], s0 = p[0], a = -s0 * fabs(v) / stribeck2(v, p[3], p[4], p[5]), in = v + p[6] * u[1];
    x[0] = relaxed(x[0], in + a * x[0], a, h);
    o[0] = s0 * x[0] + p[1] * (in + a * x[0]) + p[2] * v;
}
static void AdaptiveLuGreObserver(ARGS) {
    double v = u[0], s0 = p[0], a = -s0 * fabs(v) / stribeck2(v, p[3], p[4], p[5]), in = v + p[6] * u[1];
    double f = in + a * x[0], zm = mean(x[0], f, a, h);
    double rate = p[7] * (s0 * zm + p[1] * (in + a * zm)) * (p[8] * u[1] + u[2]), tm = x[1] + 0.5 * h * rate;
    x[0] = relaxed(x[0], f, a, h);
    if (!((tm >= p[9] && rate > 0) || (tm <= 0 && rate < 0)))
        x[1] += h * rate;
    o[0] = x[1] * (s0 * x[0] + p[1] * (in + a * x[0])) + p[2] * v;
}
static void Dahl(ARGS) {
    double v = u[0], a = -p[1] * fabs(v) / p[0];
    x[0] += h * fabs(v);
    x[1] = relaxed(x[1], p[1] * v + a * x[1], a, h);
    o[0] = x[1];
}
static void DahlPower(ARGS) {
    double v = u[0], Fc = p[0], sigma = p[1], i = p[2], near = i < 1 ? 1e-6 : 1e-12; /* a straight line below `near` */
    double s = sgn(v), m = x[0], f = 0, a = 0;
    for (int k = 0; k < 4; k++) {
        double gap = 1 - m / Fc * s, size = fabs(gap), below = pow(fmax(size, near), i - 1);
        f = sigma * below * gap * v;
        a = fmin(-sigma * (size > near ? i : 1) * below * v * s / Fc, 0);
        f += a * (x[0] - m);
        if (k < 3)
            m = mean(x[0], f, a, h);
    }
    x[0] = relaxed(x[0], f, a, h);
    o[0] = x[0];
}
static void BlimanSorine(ARGS) {
    double v = u[0], f1 = p[0], f2 = p[1], eps = p[3], af = -fabs(v) / (p[2] * eps), as = -fabs(v) / eps;
    x[0] += h * fabs(v);
    x[1] = relaxed(x[1], f1 * v / (p[2] * eps) + af * x[1], af, h);
    x[2] = relaxed(x[2], -f2 * v / eps + as * x[2], as, h);
    o[0] = x[1] + x[2];
}
static void BlimanSorine1(ARGS) {
    double v = u[0], a = -fabs(v) / p[1];
    x[0] += h * fabs(v);
    x[1] = relaxed(x[1], p[0] * v / p[1] + a * x[1], a, h);
    o[0] = x[1];
}
static void BoucWen(ARGS) {
    double v = u[0], Fc = p[0], A = p[1], beta = p[2], gamma = p[3], n = p[4], m = x[0], f = 0, a = 0;
    for (int k = 0; k < 4; k++) {
        double s = sgn(m), size = fabs(m), below = pow(size, n - 1), c = beta * fabs(v) * s + gamma * v;
        f = A * v - c * below * size;
        a = fmin(-c * n * below * s, 0);
        f += a * (x[0] - m);
        if (k < 3)
            m = mean(x[0], f, a, h);
    }
    x[0] = relaxed(x[0], f, a, h);
    o[0] = Fc * x[0];
}
static void ElastoPlastic(ARGS) {
    double v = u[0], s0 = p[0], Fc = p[3], g = stribeck2(v, Fc, p[4], p[5]), ba = p[6];
    double z_ba = ba * Fc / s0, w = fmax(g / s0 - z_ba, (1 - ba) * Fc / s0), c = s0 * fabs(v) / g;
    double m = x[0], f = 0, a = 0;
    for (int k = 0; k < 5; k++) {
        double alpha = 0, slope = 0;
        if (m * v > 0) {
            double rise = (fabs(m) - z_ba) / w;
            if (rise >= 1)
                alpha = 1;
            else if (rise > 0) {
                alpha = 0.5 - 0.5 * cos(3.141592653589793 * rise);
                if (k < 4)
                    slope = 0.5 * 3.141592653589793 * sin(3.141592653589793 * rise) * sgn(m) / w;
            }
        }
        f = v - alpha * c * m;
        if (k == 4)
            break; /* the rate that the force needs */
        a = fmin(-c * (alpha + m * slope), 0);
        f += a * (x[0] - m);
        m = k < 3 ? mean(x[0], f, a, h) : relaxed(x[0], f, a, h);
    }
    x[0] = m;
    o[0] = s0 * clamp(m, -p[4] / s0, p[4] / s0) + p[1] * exp(-sq(v / p[7])) * f + p[2] * v;
}
static void GearEfficiency(ARGS) {
    double v = u[0], Fl = u[1], a = -fabs(v) / p[2];
    x[0] += h * fabs(v);
    x[1] = relaxed(x[1], v / p[2] + a * x[1], a, h);
    o[0] = p[0] * fabs(Fl) * x[1] + p[1] * Fl * x[1] * x[1];
}
static void Gonthier(ARGS) {
    double v = u[0], s0 = p[0], s1 = p[1], Fc = p[3], Fs = p[4], s = exp(-sq(v / p[5]));
    double r = clamp(v / p[6], -1, 1), dir = r * (1.5 - 0.5 * r * r), sd = x[0], z = x[1];
    double at = s >= sd ? -1 / p[7] : -s0 / s1, fd = (sd - s) * at, sdm = mean(sd, fd, at, h);
    double a_free = -(1 - s) * s0 / s1, in = s * v + (1 - s) * Fc * dir / s1, m = z, f = 0, a = 0;
    for (int k = 0; k < 4; k++) {
        double most = Fc + (Fs - Fc) * (k ? sdm : sd), free = in + a_free * m, Fb = s0 * m + s1 * free;
        if (fabs(Fb) <= most)
            f = free, a = a_free;
        else
            f = (copysign(most, Fb) - s0 * m) / s1, a = -s0 / s1;
        f += a * (z - m);
        if (k < 3)
            m = mean(z, f, a, h);
    }
    x[0] = sd = relaxed(sd, fd, at, h);
    x[1] = z = relaxed(z, f, a, h);
    o[0] = Fc + (Fs - Fc) * sd;
    o[1] = clamp(s0 * z + s1 * (in + a_free * z), -o[0], o[0]) + p[2] * v;
}
static void RateState(ARGS) {
    double v = u[0], Fn = p[0], a = p[2], v0 = p[4], D = p[5], rate = -fabs(v) / D;
    x[0] = relaxed(x[0], 1 + rate * x[0], rate, h);
    double psi = p[1] + p[3] * log(v0 / D * x[0]), y = fabs(v) / (2 * v0) * exp(psi / a);
    o[0] = Fn * a * log(y + sqrt(y * y + 1)) * sgn(v);
}
static void PositionDependent(ARGS) {
    double v = u[0];
    x[0] += h * v;
    double angle = 6.283185307179586 * x[0] / p[0];
    o[0] = p[7] * sgn(v) * (1 + p[1] * cos(angle + p[2]) + p[3] * cos(2 * angle + p[4])) + p[5] * v + p[6] * sin(angle);
}

/* ---- regimes ---- */

enum { STICK, PLUS, MINUS };

static void Armstrong(ARGS) {
    double v = u[0], kt = p[0], Fc = p[1], Fv = p[2], E_inf = p[3], vs = p[4], gamma = p[6];
    double *ring = x + 5; /* x t2 Ea mode count, 256 samples of v */
    if (x[3] == STICK)
        x[0] += h * v, x[1] += h;
    double back = p[5] / h - 1, whole = floor(back), part = back - whole;
    int64_t count = (int64_t)x[4], newer = count - (int64_t)whole;
    double last = ring[newer & 255], vl = part == 0 ? last : last + part * (ring[(newer - 1) & 255] - last);
    x[4] = (double)++count;
    ring[count & 255] = v;
    double E = x[2] + (E_inf - x[2]) * x[1] / (x[1] + gamma), left = E / (1 + sq(vl / vs));
    if (x[3] == STICK) {
        double pull = kt * x[0];
        if (pull > Fc + E && v > 0)
            x[3] = PLUS;
        else if (pull < -(Fc + E) && v < 0)
            x[3] = MINUS;
    } else if (x[3] == PLUS ? v < 0 : v > 0) {
        x[0] = (x[3] == PLUS ? 1 : -1) * (Fc + left) / kt;
        x[1] = 0;
        x[2] = E = left;
        x[3] = STICK;
    }
    o[0] = Fc + E;
    o[1] = x[3] == STICK ? kt * x[0] : (x[3] == PLUS ? 1 : -1) * (Fc + left) + Fv * v;
}
/* f mode and the speed before */
static inline void gms_element(double *f, double *mode, double before, double v, double k, double C, double limit, double h) {
    if (*mode == 0) {
        *f += h * k * v;
        if (fabs(*f) > limit && *f * v > 0)
            *mode = 1;
    } else {
        double a = -C / limit;
        *f = relaxed(*f, C * sgn(*f) + a * *f, a, h);
        if (before * v < 0)
            *mode = 0;
    }
}
static void GMSElement(ARGS) {
    gms_element(&x[0], &x[1], x[2], u[0], p[0], p[1], u[1], h);
    x[2] = u[0];
    o[0] = x[0];
}
static void GMS(ARGS) {
    double v = u[0], limit = stribeck2(v, p[0], p[1], p[2]) / 4;
    for (int i = 0; i < 4; i++)
        gms_element(&x[2 * i], &x[2 * i + 1], x[8], v, p[3] / (i + 1), p[4] / 4, limit, h);
    x[8] = v;
    o[0] = x[0] + x[2] + x[4] + x[6] + p[5] * v;
}
static void GMS4(ARGS) {
    double v = u[0], g = stribeck2(v, p[0], p[1], p[2]); /* Fc Fs vs Fv; k, share, C of each element */
    for (int i = 0; i < 4; i++)
        gms_element(&x[2 * i], &x[2 * i + 1], x[8], v, p[4 + i], p[12 + i], p[8 + i] * g, h);
    x[8] = v;
    o[0] = x[0] + x[2] + x[4] + x[6] + p[3] * v;
}
static inline void maxwell_element(double *f, double *mode, double v, double k, double W, double h) {
    if (*mode == STICK) {
        *f += h * k * v;
        if (*f > W && v > 0)
            *f = W, *mode = PLUS;
        else if (*f < -W && v < 0)
            *f = -W, *mode = MINUS;
    } else if (*mode == PLUS ? v < 0 : v > 0)
        *mode = STICK;
}
static void MaxwellElement(ARGS) {
    maxwell_element(&x[0], &x[1], u[0], p[0], p[1], h);
    o[0] = x[0];
}
static void MaxwellSlip(ARGS) {
    for (int i = 0; i < 4; i++)
        maxwell_element(&x[2 * i], &x[2 * i + 1], u[0], p[0] / (i + 1), p[1] / 4, h);
    o[0] = x[0] + x[2] + x[4] + x[6];
}
static void MaxwellSlip4(ARGS) {
    for (int i = 0; i < 4; i++)
        maxwell_element(&x[2 * i], &x[2 * i + 1], u[0], p[i], p[4 + i], h);
    o[0] = x[0] + x[2] + x[4] + x[6];
}
/* z, and f and mode of each spring, with its stiffness k and its force W; g: the Stribeck curve; returns the force
 * without its viscous part */
static inline double leuven(double *restrict x, const double *k, const double *W, double v, double g, double n,
                            double sigma1, double h) {
    double s = sgn(v), f[4] = {x[1], x[3], x[5], x[7]}, r[4] = {0}, a[4] = {0}, zm = 0, stuck[4];
    for (int i = 0; i < 4; i++)
        stuck[i] = x[2 * i + 2] == STICK ? k[i] : 0;
    double m[4] = {f[0], f[1], f[2], f[3]};
    for (int round = 0; round < 4; round++) {
        double q = (m[0] + m[1] + m[2] + m[3]) / g * s, below = pow(fabs(q), n - 1);
        double slope = -v * n * below * sq(sgn(q)) * s / g;
        zm = v * (1 - below * q);
        for (int i = 0; i < 4; i++) {
            a[i] = fmin(stuck[i] * slope, 0);
            r[i] = stuck[i] * zm + a[i] * (f[i] - m[i]);
            if (round < 3)
                m[i] = mean(f[i], r[i], a[i], h);
        }
    }
    x[0] += h * zm;
    double sum = 0;
    for (int i = 0; i < 4; i++)
        sum += f[i] = relaxed(f[i], r[i], a[i], h);
    /* The regimes see the speed of the deflection before any of them changes. */
    double q = sum / g * s, zv = v * (1 - pow(fabs(q), n - 1) * q);
    for (int i = 0; i < 4; i++) {
        double *mode = &x[2 * i + 2];
        if (*mode == STICK) {
            if (f[i] > W[i] && zv > 0)
                f[i] = W[i], *mode = PLUS;
            else if (f[i] < -W[i] && zv < 0)
                f[i] = -W[i], *mode = MINUS;
        } else if (*mode == PLUS ? zv < 0 : zv > 0)
            *mode = STICK;
        x[2 * i + 1] = f[i];
    }
    sum = f[0] + f[1] + f[2] + f[3];
    q = sum / g * s, zv = v * (1 - pow(fabs(q), n - 1) * q);
    return sum + sigma1 * zv;
}
static void LeuvenModified(ARGS) {
    double k0 = p[0], W = p[1] / 4, v = u[0]; /* k0 Wh n sigma1 sigma2 Fc Fs vs */
    double k[4] = {k0, k0 / 2, k0 / 3, k0 / 4}, all[4] = {W, W, W, W};
    o[0] = leuven(x, k, all, v, stribeck2(v, p[5], p[6], p[7]), p[2], p[3], h) + p[4] * v;
}
static void LeuvenModified4(ARGS) {
    double v = u[0]; /* n sigma1 sigma2 Fc Fs vs, k, W */
    o[0] = leuven(x, p + 6, p + 10, v, stribeck2(v, p[3], p[4], p[5]), p[0], p[1], h) + p[2] * v;
}
static void Karnopp(ARGS) {
    UNUSED(h);
    double v = u[0], F_ext = u[1], Fc = p[0], Fs = p[1], Fv = p[2], Dv = p[3];
    if (x[0] == STICK)
        x[0] = v >= Dv ? PLUS : v <= -Dv ? MINUS : STICK;
    else if (x[0] == PLUS ? v < Dv : v > -Dv)
        x[0] = STICK;
    int stuck = x[0] == STICK;
    o[0] = stuck ? clamp(F_ext + Fs / Dv * v, -Fs, Fs) : (x[0] == PLUS ? Fc : -Fc) + Fv * v;
    o[1] = stuck ? 0 : v;
}
static void KarnoppPublished(ARGS) {
    UNUSED(h);
    double v = u[0], Fs = p[1];
    int slides = fabs(v) >= p[3];
    x[0] = slides;
    o[0] = slides ? p[0] * sgn(v) + p[2] * v : clamp(u[1], -Fs, Fs);
    o[1] = slides ? v : 0;
}
/* Held, or sliding one way: what kinetic friction with exact rest shares. */
static inline void hold(double *slip, double *mode, double v, double F_ext, double Fs, double v_hold, double x_hold) {
    if (*mode == STICK) {
        if ((F_ext > Fs && v >= 0) || v > v_hold || *slip > x_hold)
            *mode = PLUS;
        else if ((F_ext < -Fs && v <= 0) || v < -v_hold || *slip < -x_hold)
            *mode = MINUS;
    } else if (*mode == PLUS ? v < 0 : v > 0)
        *mode = STICK, *slip = 0;
}
static void KFM(ARGS) {
    double v = u[0], F_ext = u[1], Fc = p[0], Fs = p[1];
    if (x[1] == STICK)
        x[0] += h * v;
    hold(&x[0], &x[1], v, F_ext, Fs, p[4], p[5]);
    o[0] = x[1] == STICK ? clamp(F_ext + p[3] * v, -Fs, Fs) : (x[1] == PLUS ? Fc : -Fc) + p[2] * v;
}
static void KFMDwell(ARGS) {
    double v = u[0], F_ext = u[1], Fc = p[0], gamma = p[3], before = x[2];
    if (before == STICK)
        x[0] += h * v, x[1] += h;
    double Fs = Fc + (p[1] - Fc) * x[1] / (x[1] + gamma);
    hold(&x[0], &x[2], v, F_ext, Fs, p[6], p[7]);
    if (before != STICK && x[2] == STICK)
        x[1] = 0, Fs = Fc;
    o[0] = Fs;
    o[1] = x[2] == STICK ? clamp(F_ext + p[5] * v, -Fs, Fs) : (x[2] == PLUS ? Fc : -Fc) + p[2] * v;
}
static void Sticking(ARGS) {
    /* peak peak_back B v_hold x_hold v_min; Fc Fs vs Fv of the law. Unless it is set, peak_back is peak. */
    double v = u[0], F_ext = u[1], v_min = p[5], Fs = 0, peak = F_ext >= 0 ? p[0] : p[1];
    double beside = F_ext >= 0 ? v_min : -v_min;
#define LAW(w) (stribeck2(w, p[6], p[7], p[8]) * sgn(w) + p[9] * (w))
    if (x[1] == STICK) {
        x[0] += h * v;
        Fs = peak * fabs(LAW(beside));
    }
    hold(&x[0], &x[1], v, F_ext, Fs, p[3], p[4]);
    if (x[1] == STICK) {
        Fs = peak * fabs(LAW(beside));
        o[0] = clamp(F_ext + p[2] * v, -Fs, Fs);
    } else {
        double w = x[1] == PLUS ? fmax(v, v_min) : fmin(v, -v_min);
        o[0] = LAW(w);
    }
}
static void ResetIntegrator(ARGS) {
    double v = u[0], z0 = p[2];
    if (x[1] == STICK) {
        x[0] += h * v;
        if (x[0] > z0 && v > 0)
            x[0] = z0, x[1] = PLUS;
        else if (x[0] < -z0 && v < 0)
            x[0] = -z0, x[1] = MINUS;
    } else if (x[1] == PLUS ? v < 0 : v > 0)
        x[1] = STICK;
    o[0] = x[1] == STICK ? (1 + p[3]) * p[0] * x[0] + p[1] * v : p[0] * x[0];
}
static void BristleMass(ARGS) {
    double v = u[0], s0 = p[0], s1 = p[1], mb = p[2], Fc = p[3], Fs = p[4], vs = p[5], z = x[0], s = x[1];
    if (x[2] == STICK)
        x[0] = z += h * (v - s);
    else {
        double way = x[2] == PLUS ? 1 : -1, zm = z, sm = s, fz = 0, fs = 0, a = 0;
        for (int k = 0; k < 4; k++) {
            double e = (Fs - Fc) * exp(-sq(sm / vs));
            fz = v - sm;
            a = fmin((-s1 + way * e * 2 * sm / (vs * vs)) / mb, 0);
            fs = (s0 * zm + s1 * (v - sm) - way * (Fc + e)) / mb + a * (s - sm);
            if (k < 3)
                zm = z + 0.5 * h * fz, sm = mean(s, fs, a, h);
        }
        x[0] = z += h * fz;
        x[1] = s = relaxed(s, fs, a, h);
    }
    double pull = s0 * z + s1 * (v - s);
    if (x[2] == STICK) {
        if (pull > Fs)
            x[2] = PLUS;
        else if (pull < -Fs)
            x[2] = MINUS;
    } else if (x[2] == PLUS ? s < 0 : s > 0) {
        x[1] = s = 0;
        x[2] = STICK;
        pull = s0 * z + s1 * v;
    }
    o[0] = pull + p[6] * v;
}

/* ---- chance ---- */

static inline double chance(int64_t seed, int64_t k) {
    uint64_t z = (uint64_t)seed * 0x9E3779B97F4A7C15u + (uint64_t)k;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    z ^= z >> 31;
    return (double)(z >> 11) / 9007199254740992.0;
}
static inline double bond(double *b, double *n, double x, double sigma, double delta, int64_t seed) {
    double stretch = x - *b;
    if (stretch > delta || -stretch > delta) {
        double back = delta * chance(seed, (int64_t)*n);
        *b = stretch > 0 ? x - back : x + back;
        *n += 1;
    }
    return sigma * (x - *b);
}
static void BristleElement(ARGS) {
    UNUSED(h);
    o[0] = bond(&x[0], &x[1], u[0], p[0], p[1], (int64_t)p[2]);
}
static void Bristles(ARGS) {
    double Fc = p[0], delta = p[1], sigma = 1.5 * Fc / (20 * delta), sum = 0;
    x[0] += h * u[0];
    for (int i = 0; i < 20; i++)
        sum += bond(&x[2 * i + 1], &x[2 * i + 2], x[0], sigma, delta, i + 1);
    o[0] = sum;
}

/* ---- controllers ---- */

static inline int due(double count, double period, double h) { return (int64_t)count % llrint(period / h) == 0; }

static void PID(ARGS) {
    double r = u[0], y = u[1], Kp = p[0], Td = p[2], N = p[3], Tt = p[4], most = p[6], w = N / Td;
    double f = w * (y - x[1]), ym = mean(x[1], f, -w, h), rate = Kp / p[1] * (r - y);
    double lead = Kp * (p[5] * r - y) - Kp * N * (y - ym), raw = lead + x[0] + 0.5 * h * rate;
    if (fabs(raw) > most)
        x[0] = relaxed(x[0], rate + (copysign(most, raw) - lead - x[0]) / Tt, -1 / Tt, h);
    else
        x[0] += h * rate;
    x[1] = relaxed(x[1], f, -w, h);
    o[0] = clamp(Kp * (p[5] * r - y) + x[0] - Kp * N * (y - x[1]), -most, most);
}
static void PIDDiscrete(ARGS) {
    double r = u[0], y = u[1], Kp = p[0], Ti = p[1], Td = p[2], N = p[3], Tt = p[4], most = p[6], Ts = p[7];
    x[3] += 1;
    if (due(x[3], Ts, h)) {
        double d1 = (Td * x[1] - Kp * Td * N * (y - x[2])) / (Td + N * Ts);
        double raw = Kp * (p[5] * r - y) + x[0] + d1, out = clamp(raw, -most, most);
        x[0] += Ts * (Kp / Ti * (r - y) + (out - raw) / Tt);
        x[1] = d1;
        x[2] = y;
        x[4] = out;
    }
    o[0] = x[4];
}
static void PIDSpeed(ARGS) {
    double e = u[0] - u[1];
    x[0] += h * p[1] * e;
    o[0] = p[0] * e + x[0] - p[2] * u[2];
}
static void Cascade(ARGS) {
    double Kv = p[1], most = p[4], e = clamp(p[0] * (u[0] - u[1]), -p[3], p[3]) - u[2], rate = Kv / p[2] * e;
    double raw = Kv * e + x[0] + 0.5 * h * rate;
    if (!(fabs(raw) > most && raw * e > 0))
        x[0] += h * rate;
    o[0] = clamp(Kv * e + x[0], -most, most);
}
static void CascadeDiscrete(ARGS) {
    double Kv = p[1], most = p[4], Ts = p[5];
    x[1] += 1;
    if (due(x[1], Ts, h)) {
        double e = clamp(p[0] * (u[0] - u[1]), -p[3], p[3]) - u[2], raw = Kv * e + x[0];
        x[2] = clamp(raw, -most, most);
        if (!(fabs(raw) > most && raw * e > 0))
            x[0] += Ts * Kv / p[2] * e;
    }
    o[0] = x[2];
}
static void FeedForward(ARGS) {
    STATELESS;
    double v = u[0]; /* share; Fc Fs Fv vs of the law */
    o[0] = p[0] * (stribeck2(v, p[1], p[2], p[4]) * tanh(v / 5e-4) + p[3] * v);
}
static void Dither(ARGS) {
    x[0] += 1;
    o[0] = u[0] + p[0] * sin(6.283185307179586 * p[1] * (x[0] * h));
}
static void SineProfile(ARGS) {
    UNUSED(u);
    x[0] += 1; /* count */
    double A = 0.5 * p[0], w = 6.283185307179586 * p[1], angle = w * (x[0] * h), s = sin(angle), c = cos(angle);
    o[0] = A * (1 - c);
    o[1] = A * w * s;
    o[2] = A * w * w * c;
}
static void Knocker(ARGS) {
    double want = u[0]; /* u_last count height begun */
    x[1] += 1;
    double t = x[1] * h;
    if (due(x[1], p[2], h)) {
        x[2] = fabs(u[1]) > p[3] ? p[0] * sgn(want - x[0]) : 0;
        x[3] = t;
        x[0] = want;
    }
    o[0] = x[2];
    o[1] = x[3];
    o[2] = t - x[3] < p[1] ? want + x[2] : want;
}
static void AdaptiveCoulomb(ARGS) {
    double s = sgn(u[2]), rate = p[0] * (p[1] * u[0] + u[1]) * s, m = x[0] + 0.5 * h * rate;
    if (!(fabs(m) >= p[2] && m * rate > 0))
        x[0] += h * rate;
    o[0] = x[0] * s;
}
static void StictionPush(ARGS) {
    STATELESS;
    o[0] = p[0] * clamp(u[0] / p[2], -1, 1) * (1 - fmin(fabs(u[1]) / p[1], 1));
}
static void Lag(ARGS) {
    UNUSED(o);
    x[0] = relaxed(x[0], (u[0] - x[0]) / p[0], -1 / p[0], h);
}
static void KFMClip(ARGS) {
    double v = u[0], F_ext = u[1], Fc = p[0], Fs = p[1], Fv = p[2], m = p[3], Ts = p[4];
    x[0] += 1; /* count rests F */
    if (due(x[0], Ts, h)) {
        int rests = x[1] != 0 || fabs(v) < p[5];
        double pull = F_ext + m * v / Ts, dir = rests ? sgn(pull) : sgn(v);
        double slid = (v + Ts * F_ext / m - dir * Ts * Fc / m) / (1 + Ts * Fv / m);
        int stops = (rests && fabs(pull) <= Fs) || slid * dir <= 0;
        x[1] = stops;
        x[2] = F_ext - m * ((stops ? 0 : slid) - v) / Ts;
    }
    o[0] = x[2];
}
static void SampleHold(ARGS) {
    x[0] += 1; /* count y */
    if (due(x[0], p[0], h))
        x[1] = u[0];
    o[0] = x[1];
}
static void RateLimiter(ARGS) {
    x[1] += 1; /* last count y */
    if (due(x[1], p[2], h)) {
        double low = -p[1] * p[2], high = p[0] * p[2], d = u[0] - x[0];
        x[2] = x[0] + (d < low ? low : d > high ? high : d);
        x[0] = x[2];
    }
    o[0] = x[2];
}
static void UnitDelay(ARGS) {
    x[1] += 1; /* last count y */
    if (due(x[1], p[0], h)) {
        x[2] = x[0];
        x[0] = u[0];
    }
    o[0] = x[2];
}

/* ---- observers ---- */

static void DisturbanceObserver(ARGS) {
    double T = p[1], push = p[0] / T * u[0];
    x[0] = relaxed(x[0], (u[1] + push - x[0]) / T, -1 / T, h);
    o[0] = x[0] - push;
}
static void DisturbanceObserver2(ARGS) {
    double T = p[1], push = p[0] / T * u[0], q = x[0], f = (u[1] + push - q) / T, c = phi(-h / T);
    double m = mean(q, f, -1 / T, h);
    x[0] += h * c * f;
    x[1] += h * c * (m - push - x[1]) / T;
    o[0] = x[1];
}
/* Linear systems by the matrix exponential: the Taylor series of the step, each term from the one before, c1 = h f,
 * ck+1 = h A ck/(k + 1). Where its last term is not small, h A is too large for it, and the step is iterated. */
enum { TERMS = 16 };
static const double over[TERMS + 1] = {0, 1, 1. / 2, 1. / 3, 1. / 4, 1. / 5, 1. / 6, 1. / 7, 1. / 8, 1. / 9, 1. / 10,
                                       1. / 11, 1. / 12, 1. / 13, 1. / 14, 1. / 15, 1. / 16};
static inline int small(double term, double size) { return fabs(term) <= 1e-6 * size; }

static void ExtendedStateObserver(ARGS) {
    double y = u[0], w = p[1], a = u[1] / p[0], d = y - x[0], q1 = 3 * w * h, q2 = 3 * w * w * h, q3 = w * w * w * h;
    double t1 = h * x[1] + q1 * d, t2 = h * (x[2] + a) + q2 * d, t3 = q3 * d;
    double e1 = t1, e2 = t2, e3 = t3, s1 = fabs(t1), s2 = fabs(t2), s3 = fabs(t3);
    for (int k = 2; k <= TERMS; k++) {
        double n1 = over[k] * (h * t2 - q1 * t1), n2 = over[k] * (h * t3 - q2 * t1);
        t3 = over[k] * -q3 * t1, t1 = n1, t2 = n2;
        e1 += t1, e2 += t2, e3 += t3;
        s1 += fabs(t1), s2 += fabs(t2), s3 += fabs(t3);
    }
    if (small(t1, s1) && small(t2, s2) && small(t3, s3)) {
        x[0] += e1, x[1] += e2, x[2] += e3;
    } else {
        double c2 = phi2(-3 * w * h), m1 = x[0], m2 = x[1], m3 = x[2], f1 = 0, f2 = 0, f3 = 0;
        for (int k = 0; k < 4; k++) {
            d = y - m1;
            f1 = m2 + 3 * w * (y - x[0]);
            f2 = m3 + a + 3 * w * w * d;
            f3 = w * w * w * d;
            if (k < 3)
                m1 = x[0] + h * c2 * f1, m2 = x[1] + 0.5 * h * f2, m3 = x[2] + 0.5 * h * f3;
        }
        x[0] = relaxed(x[0], f1, -3 * w, h);
        x[1] += h * f2;
        x[2] += h * f3;
    }
    o[0] = x[1];
    o[1] = -p[0] * x[2];
}
static void SpeedObserver(ARGS) {
    double y = u[0], w = p[0], d = y - x[0], q1 = 2 * w * h, q2 = w * w * h;
    double t1 = h * x[1] + q1 * d, t2 = q2 * d, e1 = t1, e2 = t2, s1 = fabs(t1), s2 = fabs(t2);
    for (int k = 2; k <= TERMS; k++) {
        double n1 = over[k] * (h * t2 - q1 * t1);
        t2 = over[k] * -q2 * t1, t1 = n1;
        e1 += t1, e2 += t2;
        s1 += fabs(t1), s2 += fabs(t2);
    }
    if (small(t1, s1) && small(t2, s2)) {
        x[0] += e1, x[1] += e2;
    } else {
        double c2 = phi2(-2 * w * h), m1 = x[0], m2 = x[1], f1 = 0, f2 = 0;
        for (int k = 0; k < 4; k++) {
            f1 = m2 + 2 * w * (y - x[0]);
            f2 = w * w * (y - m1);
            if (k < 3)
                m1 = x[0] + h * c2 * f1, m2 = x[1] + 0.5 * h * f2;
        }
        x[0] = relaxed(x[0], f1, -2 * w, h);
        x[1] += h * f2;
    }
    o[0] = x[1];
}
static void FriedlandPark(ARGS) {
    double v = u[0], m = p[0], k = p[1], v1 = p[3], s = sgn(v), r = fabs(v / v1), below = pow(r, p[2] - 1);
    double offset = k * v1 * below * r, c = k * p[2] * below;
    x[0] = relaxed(x[0], c * (u[1] / m - (x[0] - offset) * s) * s, -c * s * s, h);
    o[0] = m * (x[0] - offset);
    o[1] = o[0] * s;
}

/* ---- plants ---- */

static void Axis(ARGS) {
    UNUSED(o);
    double a = (u[0] - u[1]) / p[0];
    x[0] += h * (x[1] + 0.5 * h * a);
    x[1] += h * a;
}
static void BandedAxis(ARGS) {
    double a = (u[0] - u[1]) / p[0], half = x[1] + 0.5 * h * a, Dv = p[1];
    if (fabs(half) >= Dv)
        x[0] += h * half;
    x[1] += h * a;
    o[0] = fabs(x[1]) < Dv ? 0 : x[1];
}
static inline double stop(double x, double v, double low, double high, double k, double d) {
    return x > high ? fmax(k * (x - high) + d * v, 0) : x < low ? fmin(k * (x - low) + d * v, 0) : 0;
}
static void EndStops(ARGS) {
    STATELESS;
    o[0] = u[0] > p[1] || u[0] < p[0];
    o[1] = stop(u[0], u[1], p[0], p[1], p[2], p[3]);
}
static void StoppedAxis(ARGS) {
    double m = p[0], k = p[3], d = p[4], mx = x[0], mv = x[1], fx = 0, fv = 0, a = 0; /* m low high k d */
    for (int round = 0; round < 4; round++) {
        double F = stop(mx, mv, p[1], p[2], k, d);
        a = F != 0 ? -d / m : 0;
        fx = mv;
        fv = (u[0] - F) / m + a * (x[1] - mv);
        if (round < 3)
            mx = x[0] + 0.5 * h * fx, mv = mean(x[1], fv, a, h);
    }
    o[0] = x[0] += h * fx;
    o[1] = x[1] = relaxed(x[1], fv, a, h);
}
/* Two masses with `KFM` between them. Where they come to rest on each other, they go on with their common momentum, and
 * so they do where the speed is what the rounding of the force makes in a step. */
static void Clutch(ARGS) {
    double F1 = u[0], F2 = u[1], m1 = p[0], m2 = p[1], Fc = p[2], Fs = p[3], Fv = p[4], B = p[5];
    double F_ext = (m2 * F1 - m1 * F2) / (m1 + m2), both = 1 / m1 + 1 / m2; /* x1 v1 x2 v2 slip mode */
    int stuck = x[5] == STICK;
    double dry = x[5] == PLUS ? Fc : -Fc, n1 = x[1], n2 = x[3], f1 = 0, f2 = 0, a1 = 0, a2 = 0;
#define FORCE(v) (stuck ? clamp(F_ext + B * (v), -Fs, Fs) : dry + Fv * (v))
    for (int round = 0; round < 4; round++) {
        double v = n1 - n2, F = FORCE(v), slope = stuck ? (fabs(F_ext + B * v) < Fs ? B : 0) : Fv;
        a1 = -slope / m1, a2 = -slope / m2;
        f1 = (F1 - F) / m1 + a1 * (x[1] - n1);
        f2 = (F2 + F) / m2 + a2 * (x[3] - n2);
        if (round < 3)
            n1 = mean(x[1], f1, a1, h), n2 = mean(x[3], f2, a2, h);
    }
    x[0] += h * n1;
    x[1] = relaxed(x[1], f1, a1, h);
    x[2] += h * n2;
    x[3] = relaxed(x[3], f2, a2, h);
    if (stuck)
        x[4] += h * (n1 - n2);
    double v = x[1] - x[3], F = FORCE(v);
    hold(&x[4], &x[5], v, F_ext, Fs, p[6], p[7]);
    if ((!stuck && x[5] == STICK) || fabs(v) <= 0x1p-20 * fabs(h * both * F)) {
        x[1] -= v / both / m1;
        x[3] += v / both / m2;
    }
    stuck = x[5] == STICK;
    dry = x[5] == PLUS ? Fc : -Fc;
    o[0] = v = x[1] - x[3];
    o[1] = FORCE(v);
#undef FORCE
}
static void DriveTorque(ARGS) {
    double T = p[3], wanted = clamp(u[0], -p[0], p[0]), q = p[1], sent = q > 0 ? q * floor(wanted / q + 0.5) : wanted;
    double *ring = x + 2, back = p[2] / h - 0.5, demand; /* F count, 128 samples of what was sent */
    int64_t count = (int64_t)x[1];
    if (back < 0) {
        double last = ring[count & 127];
        demand = last - 2 * back * (sent - last);
    } else {
        double whole = floor(back);
        int64_t newer = count - (int64_t)whole;
        double last = ring[newer & 127];
        demand = last + (back - whole) * (ring[(newer - 1) & 127] - last);
    }
    x[0] = relaxed(x[0], (demand - x[0]) / T, -1 / T, h);
    x[1] = (double)++count;
    ring[count & 127] = sent;
    UNUSED(o);
}
static void DriveTorqueSampled(ARGS) {
    double T = p[2]; /* F read count demand */
    x[0] = relaxed(x[0], (x[3] - x[0]) / T, -1 / T, h);
    x[2] += 1;
    if (due(x[2], p[3], h)) {
        double wanted = clamp(u[0], -p[0], p[0]), q = p[1];
        x[3] = x[1];
        x[1] = q > 0 ? q * floor(wanted / q + 0.5) : wanted;
    }
    o[0] = x[3];
}
static void Encoder(ARGS) {
    x[1] += 1; /* y_old count y v */
    if (due(x[1], p[1], h)) {
        double now = p[0] * floor(u[0] / p[0]);
        x[2] = now;
        x[3] = (now - x[0]) / p[1];
        x[0] = now;
    }
    o[0] = x[2];
    o[1] = x[3];
}
static void TwoMass(ARGS) {
    double m1 = p[0], m2 = p[1], k = p[2], d = p[3], half = 0.5 * p[4], F = 0, f[4] = {0}, a1 = 0, a2 = 0;
    double m[4] = {x[0], x[1], x[2], x[3]};
    for (int round = 0; round < 4; round++) {
        double twist = m[0] - m[2], damp = fabs(twist) >= half ? d : 0;
        F = k * (twist - clamp(twist, -half, half)) + damp * (m[1] - m[3]);
        a1 = -damp / m1, a2 = -damp / m2;
        f[0] = m[1];
        f[1] = (u[0] - F) / m1 + a1 * (x[1] - m[1]);
        f[2] = m[3];
        f[3] = (F - u[1]) / m2 + a2 * (x[3] - m[3]);
        if (round < 3) {
            m[0] = x[0] + 0.5 * h * f[0];
            m[1] = mean(x[1], f[1], a1, h);
            m[2] = x[2] + 0.5 * h * f[2];
            m[3] = mean(x[3], f[3], a2, h);
        }
    }
    x[0] += h * f[0];
    x[1] = relaxed(x[1], f[1], a1, h);
    x[2] += h * f[2];
    x[3] = relaxed(x[3], f[3], a2, h);
    double twist = x[0] - x[2];
    o[0] = k * (twist - clamp(twist, -half, half)) + (fabs(twist) >= half ? d * (x[1] - x[3]) : 0);
}

/* ---- all of them, with the names of their ports ---- */

#define EIGHT(word) word word word word word word word word
#define FOUR(of, name) of "e1." name " @mode:" of "e1 " of "e2." name " @mode:" of "e2 " of "e3." name " @mode:" of "e3 " of "e4." name " @mode:" of "e4"
#define ELEMENTS(name) "el[1]." name " @mode:el[1] el[2]." name " @mode:el[2] el[3]." name " @mode:el[3] el[4]." name " @mode:el[4]"

/* Name; which states have guards, a bit each, and the number of outputs; then the names of all ports. A state of our own
 * is a `.`, followed by the input with whose value it begins; `@` are counter and regimes. */
#define MODELS(MODEL) \
    MODEL(Ambrosio, 0x0u, 1, "v", "Fc v0 v1", "", "F") \
    MODEL(Asymmetric, 0x0u, 1, "v", "F0 pos.Fc pos.Fs pos.vs pos.Fv neg.Fc neg.Fs neg.vs neg.Fv", "", "F") \
    MODEL(BengisuAkay, 0x0u, 1, "v", "Fc Fs v0 xi", "", "F") \
    MODEL(BreakAwayTanh, 0x0u, 1, "v", "Fc Fs v_brk Fv", "", "F") \
    MODEL(BrownMcPhee, 0x0u, 1, "v Fn", "mud mus vt muv Nt", "", "F") \
    MODEL(Coulomb, 0x0u, 1, "v", "Fc", "", "F") \
    MODEL(CoulombViscous, 0x0u, 1, "v", "Fc Fv", "", "F") \
    MODEL(GearM1, 0x0u, 1, "v", "Kv Kc", "", "F") \
    MODEL(GearM2, 0x0u, 1, "v", "Kv Kc Kcs vs alpha", "", "F") \
    MODEL(GearM3, 0x0u, 1, "v F_m F_e", "Kv Kc Kl", "", "F") \
    MODEL(GearM4, 0x0u, 1, "v F_m F_e", "Kv Kc Kl Kcs Kls vs alpha", "", "F") \
    MODEL(GearM5, 0x0u, 1, "v F_m F_e", "Kv Kc Km Ke Kcs Kms Kes vs alpha", "", "F") \
    MODEL(GearM6, 0x0u, 1, "v F_m F_e", "Kv Kc Km Ke Kcs Kms Kes Keq Kmq vs alpha", "", "F") \
    MODEL(KFMSmooth, 0x0u, 1, "v", "Fc Fs Fv v0 vs", "", "F") \
    MODEL(HyperbolicAgeing, 0x0u, 1, "rest", "gamma", "", "share") \
    MODEL(ExponentialAgeing, 0x0u, 1, "rest", "tau n", "", "share") \
    MODEL(Makkar, 0x0u, 1, "v", "g1 g2 g3 g4 g5 g6", "", "F") \
    MODEL(PointsFriction, 0x0u, 1, "v", "F0 v1 F1 v2 F2 v3 F3 v4 F4", "", "F") \
    MODEL(TanhSign, 0x0u, 1, "v v0", "", "", "s") \
    MODEL(AtanSign, 0x0u, 1, "v v0", "", "", "s") \
    MODEL(RootSign, 0x0u, 1, "v v0", "", "", "s") \
    MODEL(ClampSign, 0x0u, 1, "v v0", "", "", "s") \
    MODEL(Smoothed, 0x0u, 1, "v", "v0 v_min law.Fc law.Fs law.vs law.Fv", "", "F") \
    MODEL(StribeckGauss, 0x0u, 1, "v", "Fc Fs vs Fv", "", "F") \
    MODEL(StribeckLorentz, 0x0u, 1, "v", "Fc Fs vs Fv", "", "F") \
    MODEL(BoPavelescu, 0x0u, 1, "v", "Fc Fs vs shape Fv", "", "F") \
    MODEL(LoadedStribeck, 0x0u, 1, "v Fn", "muc mus vs", "", "F") \
    MODEL(BittencourtGunnarsson, 0x0u, 1, "v Fl T", "Fc0 Fcl Fs0 FsT Fsl vs0 vsT vsl Fv0 FvT TV", "", "F") \
    MODEL(Threlfall, 0x0u, 1, "v", "Fc v1", "", "F") \
    MODEL(Tustin, 0x0u, 1, "v", "Fc Fs vs Fv", "", "F") \
    MODEL(Viscous, 0x0u, 1, "v", "Fv", "", "F") \
    MODEL(ViscousPowers, 0x0u, 1, "v", "Fc Fh v1 Fv Fq", "", "F") \
    MODEL(TableFriction, 0x0u, 1, "v", "scale", "", "F") \
    MODEL(LuGre, 0x1u, 1, "v", "sigma0 sigma1 sigma2 Fc Fs vs vd", "z", "F") \
    MODEL(LoadedLuGre, 0x1u, 1, "v Fn", "sigma0 sigma1 sigma2 muc mus vs vd", "z", "F") \
    MODEL(LuGreAsymmetric, 0x1u, 1, "v", "sigma0 sigma1 sigma2 Fcp Fsp Fcn Fsn vs vd", "z", "F") \
    MODEL(LuGreCurve, 0x1u, 1, "v", "sigma0 sigma1 vd g_min v_min curve.Fc curve.Fs curve.vs curve.Fv", "z", "F") \
    MODEL(LuGreObserver, 0x1u, 1, "v e", "sigma0 sigma1 sigma2 Fc Fs vs k", "z_hat", "F_hat") \
    MODEL(AdaptiveLuGreObserver, 0x3u, 1, "v e de", "sigma0 sigma1 sigma2 Fc Fs vs k gamma lambda theta_max", "z_hat theta", "F_hat") \
    MODEL(Dahl, 0x3u, 1, "v", "Fc sigma", "s z", "F") \
    MODEL(DahlPower, 0x1u, 1, "v", "Fc sigma i", "z", "F") \
    MODEL(BlimanSorine, 0x7u, 1, "v", "f1 f2 eta eps_f", "s xf xs", "F") \
    MODEL(BlimanSorine1, 0x3u, 1, "v", "f1 eps_f", "s x", "F") \
    MODEL(BoucWen, 0x1u, 1, "v", "Fc A beta gamma n", "z", "F") \
    MODEL(ElastoPlastic, 0x1u, 1, "v", "sigma0 sigma1 sigma2 Fc Fs vs ba vd", "z", "F") \
    MODEL(GearEfficiency, 0x3u, 1, "v F_l", "mu_a mu_d h", "s z", "F") \
    MODEL(Gonthier, 0x3u, 2, "v", "sigma0 sigma1 sigma2 Fc Fs vs v_e tau_dw", "sd z", "F_max F") \
    MODEL(RateState, 0x1u, 1, "v", "Fn mu0 a b v0 D", "theta", "F") \
    MODEL(PositionDependent, 0x1u, 1, "v", "p a1 phi1 a2 phi2 Fv Fg law.Fc", "x", "F") \
    MODEL(Armstrong, 0x7u, 2, "v", "kt Fc Fv E_inf vs tau_L gamma", "x t2 Ea @mode @count " EIGHT(EIGHT(" .v .v .v .v")), "F_max F") \
    MODEL(GMSElement, 0x1u, 1, "v limit", "k C", "f @mode .v", "F") \
    MODEL(GMS, 0x55u, 1, "v", "Fc Fs vs k0 C Fv", ELEMENTS("f") " .v", "F") \
    MODEL(GMS4, 0x55u, 1, "v", "Fc Fs vs Fv k1 k2 k3 k4 a1 a2 a3 a4 C1 C2 C3 C4", FOUR("", "f") " .v", "F") \
    MODEL(MaxwellElement, 0x1u, 1, "v", "k W", "f @mode", "F") \
    MODEL(MaxwellSlip, 0x55u, 1, "v", "k0 Fc", ELEMENTS("f"), "F") \
    MODEL(MaxwellSlip4, 0x55u, 1, "v", "k1 k2 k3 k4 W1 W2 W3 W4", FOUR("", "f"), "F") \
    MODEL(LeuvenModified, 0xabu, 1, "v", "k0 Wh n sigma1 sigma2 Fc Fs vs", "z " ELEMENTS("f"), "F") \
    MODEL(LeuvenModified4, 0xabu, 1, "v", "n sigma1 sigma2 Fc Fs vs k1 k2 k3 k4 W1 W2 W3 W4", "z " FOUR("Fh.", "f"), "F") \
    MODEL(Karnopp, 0x0u, 2, "v F_ext", "Fc Fs Fv Dv", "@mode", "F v_out") \
    MODEL(KarnoppPublished, 0x0u, 2, "v F_ext", "Fc Fs Fv Dv", "@mode", "F v_out") \
    MODEL(KFM, 0x1u, 1, "v F_ext", "Fc Fs Fv B v_hold x_hold", "slip @mode", "F") \
    MODEL(KFMDwell, 0x3u, 2, "v F_ext", "Fc Fs Fv gamma rested B v_hold x_hold", "slip dwell @mode", "F_max F") \
    MODEL(Sticking, 0x1u, 1, "v F_ext", "peak peak B v_hold x_hold v_min law.Fc law.Fs law.vs law.Fv", "slip @mode", "F") \
    MODEL(ResetIntegrator, 0x1u, 1, "v", "sigma0 sigma1 z0 a", "z @mode", "F") \
    MODEL(BristleMass, 0x3u, 1, "v", "sigma0 sigma1 mb Fc Fs vs Fv", "z s @mode", "F") \
    MODEL(BristleElement, 0x3u, 1, "x", "sigma delta seed", "b n", "F") \
    MODEL(Bristles, 0x1ffffffffffu, 1, "v", "Fc delta", "x el[1].b el[1].n el[2].b el[2].n el[3].b el[3].n el[4].b el[4].n el[5].b el[5].n el[6].b el[6].n el[7].b el[7].n el[8].b el[8].n el[9].b el[9].n el[10].b el[10].n el[11].b el[11].n el[12].b el[12].n el[13].b el[13].n el[14].b el[14].n el[15].b el[15].n el[16].b el[16].n el[17].b el[17].n el[18].b el[18].n el[19].b el[19].n el[20].b el[20].n", "F") \
    MODEL(PID, 0x3u, 1, "r y", "Kp Ti Td N Tt b u_max", "i yf", "u") \
    MODEL(PIDDiscrete, 0x17u, 1, "r y", "Kp Ti Td N Tt b u_max Ts", "i d y_old @count u", "u") \
    MODEL(PIDSpeed, 0x1u, 1, "r y v", "Kp Ki Kv", "i", "u") \
    MODEL(Cascade, 0x1u, 1, "r y v", "Kx Kv Tv v_max u_max", "i", "u") \
    MODEL(CascadeDiscrete, 0x5u, 1, "r y v", "Kx Kv Tv v_max u_max Ts", "i @count u", "u") \
    MODEL(FeedForward, 0x0u, 1, "v_d", "share law.Fc law.Fs law.Fv law.vs", "", "u") \
    MODEL(Dither, 0x0u, 1, "u_in", "A f", "@count", "u") \
    MODEL(SineProfile, 0x0u, 3, "", "A f", "@count", "r v a") \
    MODEL(Knocker, 0xdu, 3, "u_in e", "a width period e0", "u_last @count height begun", "height begun u") \
    MODEL(AdaptiveCoulomb, 0x1u, 1, "e de v_d", "gamma lambda a_max", "a", "u") \
    MODEL(StictionPush, 0x0u, 1, "e v", "Fs Dv e0", "", "u") \
    MODEL(Lag, 0x1u, 0, "u", "T", "y", "") \
    MODEL(KFMClip, 0x6u, 1, "v F_ext", "Fc Fs Fv m h v_rest", "@count rests F", "F") \
    MODEL(SampleHold, 0x2u, 1, "u", "Ts", "@count y", "y") \
    MODEL(RateLimiter, 0x5u, 1, "u", "up down Ts", "last @count y", "y") \
    MODEL(UnitDelay, 0x5u, 1, "u", "Ts", "last @count y", "y") \
    MODEL(DisturbanceObserver, 0x1u, 1, "v u", "m T", "q", "F_hat") \
    MODEL(DisturbanceObserver2, 0x3u, 1, "v u", "m T", "q f", "F_hat") \
    MODEL(ExtendedStateObserver, 0x7u, 2, "y u", "m w", "z1 z2 z3", "v_hat F_hat") \
    MODEL(FriedlandPark, 0x1u, 2, "v u", "m k p v1", "w", "Fc_hat F_hat") \
    MODEL(SpeedObserver, 0x3u, 1, "y", "w", "x_hat v_hat", "v") \
    MODEL(Axis, 0x3u, 0, "F_motor F_load", "m", "x v", "") \
    MODEL(BandedAxis, 0x3u, 1, "F_motor F_load", "m Dv", "x w", "v") \
    MODEL(EndStops, 0x0u, 2, "x v", "low high k d", "", "touches F") \
    MODEL(StoppedAxis, 0x3u, 2, "u", "m low high k d", "body.x body.v", "x v") \
    MODEL(Clutch, 0x1fu, 2, "F1 F2", "m1 m2 fr.Fc fr.Fs fr.Fv fr.B fr.v_hold fr.x_hold", "x1 v1 x2 v2 fr.slip @mode:fr", "v F") \
    MODEL(DriveTorque, 0x1u, 0, "u", "F_max q D T", "F @count " EIGHT(EIGHT(" . .")), "") \
    MODEL(DriveTorqueSampled, 0xbu, 1, "u", "F_max q T Ts", "F read @count demand", "demand") \
    MODEL(Encoder, 0xdu, 2, "x", "count Ts", "y_old @count y v", "y v") \
    MODEL(TwoMass, 0xfu, 1, "F_motor F_load", "m1 m2 k d gap", "x1 v1 x2 v2", "F_shaft")

/* The same step with guards: returns 0 if all states and outputs are finite. A sum with an infinity or a NaN is not
 * finite, and less itself it is NaN, whose bits are not 0: no branch is needed. */
#define CHECKED(name, watched, outputs, ...)                                                                           \
    __attribute__((flatten)) static int64_t name##_checked(ARGS) {                                                     \
        double sum = -0.0;                                                                                             \
        name(x, p, u, o, h);                                                                                           \
        _Pragma("GCC unroll 64") for (int k = 0; k < 64; k++) if ((uint64_t)(watched) >> k & 1) sum += x[k];           \
        _Pragma("GCC unroll 64") for (int k = 0; k < (outputs); k++) sum += o[k];                                      \
        double rest = sum - sum;                                                                                       \
        int64_t status;                                                                                                \
        memcpy(&status, &rest, sizeof status);                                                                         \
        return status;                                                                                                 \
    }
MODELS(CHECKED)

struct model {
    const char *name, *inputs, *params, *states, *outputs;
    void (*step)(ARGS);
    int64_t (*checked)(ARGS);
    uint64_t watched, number_of_outputs;
};

#define ENTRY(name, watched, outputs, ...) {#name, __VA_ARGS__, name, name##_checked, watched, outputs},
const struct model models[] = {MODELS(ENTRY){NULL, NULL, NULL, NULL, NULL, NULL, NULL, 0, 0}};
