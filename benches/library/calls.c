/* The loop around the calls of a step: the same instructions for every kind of step, so that their place favours none. A
 * step takes up to five arguments, of which ours reads three. C without guards returns nothing: its mask is 0. */
#include <stddef.h>
#include <stdint.h>

typedef int64_t step(double *, const double *, const void *, double *, double);

struct calls {
    step *step;
    double *first;
    const double *second;
    const void *third;
    double *fourth;
    double h;
    /* The bits of the status to check. */
    int64_t mask;
    /* Destination of the inputs, and their number. */
    volatile double *inputs;
    size_t width;
    /* Base and indices of the outputs. */
    const volatile double *base;
    const size_t *outputs;
    size_t number_of_outputs;
};

/* Calls the step with one row of inputs after the other; returns whether no step has failed. All outputs are read. If
 * `waits`, the inputs of a call depend on the outputs of the previous one; else the calls are independent. */
static inline int made(const struct calls *calls, const double *row, size_t number, int waits) {
    const struct calls c = *calls;
    double sum = 0;
    for (; number > 0; number--, row += c.width) {
        for (size_t k = 0; k < c.width; k++)
            c.inputs[k] = waits ? row[k] + 0.0 * sum : row[k];
        if (c.step(c.first, c.second, c.third, c.fourth, c.h) & c.mask)
            return 0;
        sum = 0;
        for (size_t k = 0; k < c.number_of_outputs; k++) {
            double output = c.base[c.outputs[k]];
            if (waits)
                sum += output;
        }
    }
    return 1;
}

int many(const struct calls *calls, const double *row, size_t number) { return made(calls, row, number, 0); }

int in_turn(const struct calls *calls, const double *row, size_t number) { return made(calls, row, number, 1); }
