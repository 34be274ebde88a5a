/* What stands around each call of a step: the same instructions for every kind of step, so that where they lie favours none.
 * A step takes up to five arguments, of which ours knows three; C that does not watch returns nothing, so nothing is asked
 * of it: the mask is 0. */
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
    /* Of the status, what is asked. */
    int64_t mask;
    /* Where inputs go, and how many. */
    volatile double *inputs;
    size_t width;
    /* Where outputs come from. */
    const volatile double *base;
    const size_t *outputs;
    size_t number_of_outputs;
};

/* Calls with one row of inputs after the other; whether no step has failed. All outputs are read. If it waits, nothing of a
 * call can begin that needs an input before the call before has left its outputs; else nothing of what stands here does. */
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
