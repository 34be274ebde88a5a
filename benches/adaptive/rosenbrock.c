/* Rodas5P by hand, for two loops with LuGre friction: what the generated code and the solver of `runtime` are measured
 * against. Dense elimination of fixed size, exp shared between rates and Jacobian, the error controlled as
 * `runtime/src/solver/adaptive.rs` does it; the kink of |v| is met by rejected steps, as such programs do. */
#include "loops.h"

static const double gamma_ = 0.21193756319429014;
static const double c_[8] = {0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1, 1, 1};
static const double d_[8] = {0.21193756319429014, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734,
                             2.325825639765069, 0, 0, 0};
static const double a_[8][7] = {
    {0},
    {3.0},
    {2.849394379747939, 0.45842242204463923},
    {-6.954028509809101, 2.489845061869568, -10.358996098473584},
    {2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946, 1.0},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946, 1.0, 1.0}};
static const double w_[8][7] = {
    {0},
    {-14.155112264123755},
    {-17.97296035885952, -2.859693295451294},
    {147.12150275711716, -1.41221402718213, 71.68940251302358},
    {165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306},
    {24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471},
    {30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783, -19.097331116725623,
     -28.087943162872662},
    {37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047, -40.06618937091002,
     -54.66780262877968, -9.48861652309627}};
static const double h_[3][8] = {
    {25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204, 0.524948541321073,
     1.1241088310450404, 0.4272876194431874, -0.17202221070155493},
    {-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796, 20.176138334709044,
     15.98066361424651, -6.789040303419874, -6.710236069923372},
    {11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643, -52.072871366152654,
     -59.78993625266729, -0.15582684282751913, 4.883087185713722}};

static int factor(double *a, int *rows) {
    for (int k = 0; k < N; k++) {
        int large = k;
        for (int r = k + 1; r < N; r++)
            if (fabs(a[r * N + k]) > fabs(a[large * N + k])) large = r;
        rows[k] = large;
        if (large != k)
            for (int c = 0; c < N; c++) {
                double s = a[k * N + c];
                a[k * N + c] = a[large * N + c];
                a[large * N + c] = s;
            }
        if (a[k * N + k] == 0) return 0;
        double inverse = a[k * N + k] = 1 / a[k * N + k];
        for (int r = k + 1; r < N; r++) {
            double part = a[r * N + k] *= inverse;
            for (int c = k + 1; c < N; c++) a[r * N + c] -= part * a[k * N + c];
        }
    }
    return 1;
}

static void solve(const double *a, const int *rows, double *b) {
    for (int k = 0; k < N; k++) {
        double s = b[k];
        b[k] = b[rows[k]];
        b[rows[k]] = s;
    }
    for (int r = 1; r < N; r++)
        for (int c = 0; c < r; c++) b[r] -= a[r * N + c] * b[c];
    for (int r = N - 1; r >= 0; r--) {
        for (int c = r + 1; c < N; c++) b[r] -= a[r * N + c] * b[c];
        b[r] *= a[r * N + r];
    }
}

static double run(double tol, double *positions) {
    double x[N] = {0}, f0[N] = {0}, j[N * N] = {0}, ft[N] = {0}, m[N * N], u[8][N], y[N], f[N], t = 0, h = 1e-4, last_h = 0, last_error = 0;
    int rows[N], next = positions ? 0 : INSTANTS + 1, known = 0, rejected = 0;
    while (t < end) {
        int hits = h > 0.999 * (end - t);
        if (hits) h = end - t;
        if (!known) rates(t, x, f0), jacobian(t, x, j, ft), known = 1;
        for (int i = 0; i < N * N; i++) m[i] = -j[i];
        for (int i = 0; i < N; i++) m[i * N + i] += 1 / (gamma_ * h);
        if (!factor(m, rows)) {
            h *= 0.5;
            continue;
        }
#pragma GCC unroll 8
        for (int s = 0; s < 8; s++) {
            for (int i = 0; i < N; i++) {
                y[i] = x[i];
                for (int k = 0; k < s; k++) y[i] += a_[s][k] * u[k][i];
            }
            if (s == 0) memcpy(f, f0, sizeof f);
            else rates(t + c_[s] * h, y, f);
            for (int i = 0; i < N; i++) {
                double sum = 0;
                for (int k = 0; k < s; k++) sum += w_[s][k] * u[k][i];
                u[s][i] = f[i] + sum / h + h * d_[s] * ft[i];
            }
            solve(m, rows, u[s]);
        }
        double error = 0;
        for (int i = 0; i < N; i++) {
            y[i] += u[7][i];
            double size = fmax(fabs(x[i]), fabs(y[i]));
            error = fmax(error, fabs(u[7][i]) / (tol * (size + scale[i])));
        }
        if (!(error <= 1)) {
            h *= fmin(0.9, fmax(0.2, 0.9 * pow(error, -0.2)));
            rejected = 1;
            continue;
        }
        while (next <= INSTANTS && end * next / INSTANTS <= t + h * (1 + 1e-14)) {
            double th = (end * next / INSTANTS - t) / h, k[3] = {0, 0, 0};
            for (int s = 0; s < 8; s++)
                for (int q = 0; q < 3; q++) k[q] += h_[q][s] * u[s][0];
            positions[next++] = x[0] + th * (y[0] - x[0] + (1 - th) * (k[0] + th * (k[1] + th * k[2])));
        }
        t = hits ? end : t + h;
        memcpy(x, y, sizeof x);
        known = 0;
        error = fmax(error, 1e-10);
        double part = 0.9 * pow(error, -0.2);
        if (last_h > 0) part = fmin(part, 0.9 * h / last_h * pow(last_error / (error * error), 0.2));
        if (rejected) part = fmin(part, 1);
        last_h = h, last_error = fmax(error, 1e-2), rejected = 0;
        h *= fmin(6, fmax(0.2, part));
        h = fmin(h, end / 50);
    }
    return x[0];
}
