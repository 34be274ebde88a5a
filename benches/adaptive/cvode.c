/* The same loops with CVODE of SUNDIALS: its method for stiff systems, BDF, with the Jacobian given; tolerances relative
 * to |x| + scale as everywhere here. */
#include "loops.h"

#include <cvode/cvode.h>
#include <nvector/nvector_serial.h>
#include <sunlinsol/sunlinsol_dense.h>
#include <sunmatrix/sunmatrix_dense.h>

static int right(realtype t, N_Vector x, N_Vector f, void *data) {
    (void)data;
    rates(t, N_VGetArrayPointer(x), N_VGetArrayPointer(f));
    return 0;
}

static int derivative(realtype t, N_Vector x, N_Vector f, SUNMatrix j, void *data, N_Vector a, N_Vector b, N_Vector c) {
    (void)f, (void)data, (void)a, (void)b, (void)c;
    double rows[N * N], ft[N];
    jacobian(t, N_VGetArrayPointer(x), rows, ft);
    for (int r = 0; r < N; r++)
        for (int k = 0; k < N; k++) SM_ELEMENT_D(j, r, k) = rows[r * N + k];
    return 0;
}

static void check(int flag) {
    if (flag < 0) {
        fprintf(stderr, "CVODE gave up: %d\n", flag);
        exit(1);
    }
}

static double run(double tol, double *positions) {
    SUNContext context;
    check(SUNContext_Create(NULL, &context));
    N_Vector x = N_VNew_Serial(N, context), sizes = N_VNew_Serial(N, context);
    for (int i = 0; i < N; i++) NV_Ith_S(x, i) = 0, NV_Ith_S(sizes, i) = tol * scale[i];
    SUNMatrix matrix = SUNDenseMatrix(N, N, context);
    SUNLinearSolver solver = SUNLinSol_Dense(x, matrix, context);
    void *memory = CVodeCreate(CV_BDF, context);
    check(CVodeInit(memory, right, 0, x));
    check(CVodeSVtolerances(memory, tol, sizes));
    check(CVodeSetLinearSolver(memory, solver, matrix));
    check(CVodeSetJacFn(memory, derivative));
    check(CVodeSetMaxNumSteps(memory, 100000000));
    check(CVodeSetMaxConvFails(memory, 1000));
    check(CVodeSetMaxErrTestFails(memory, 1000));
    check(CVodeSetStopTime(memory, end));
    for (int k = 1; k <= INSTANTS; k++) {
        realtype t;
        check(CVode(memory, end * k / INSTANTS, x, &t, CV_NORMAL));
        if (positions) positions[k] = NV_Ith_S(x, 0);
    }
    double last = NV_Ith_S(x, 0);
    if (positions) positions[0] = 0;
    CVodeFree(&memory);
    SUNLinSolFree(solver);
    SUNMatDestroy(matrix);
    N_VDestroy(x);
    N_VDestroy(sizes);
    SUNContext_Free(&context);
    return last;
}
