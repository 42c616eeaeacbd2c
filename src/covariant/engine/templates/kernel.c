#include <math.h>
#include <string.h>
/* A velocity at rest decays to subnormal numbers, with which processors compute many times as slowly: as in compiled
 * JAX they count as zero. */
#if defined __SSE2__
#include <xmmintrin.h>
#define TINY_IS_ZERO const unsigned mode = _mm_getcsr(); _mm_setcsr(mode | 0x8040u)
#define AS_BEFORE _mm_setcsr(mode)
#else
#define TINY_IS_ZERO (void)0
#define AS_BEFORE (void)0
#endif

/* xSIZESx */

/* xHELPERSx */
typedef xREALx real;
#if LANES > 1
#define LANE(array, k, i) array[k][i]
#else
#define LANE(array, k, i) array[(k) + (i)]
#endif
#define SOME(count) ((count) > 0 ? (count) : 1)

/* xCOREx */

static void load(real *into, const double *from, int count)
{
    int i, k;
    for (k = 0; k < count; ++k)
        for (i = 0; i < LANES; ++i)
            LANE(into, k, i) = from[k * LANES + i];
}

static void store(double *into, const real *from, int count)
{
    int i, k;
    for (k = 0; k < count; ++k)
        for (i = 0; i < LANES; ++i)
            into[k * LANES + i] = LANE(from, k, i);
}

static void fix(const real *o, real *fixed)
{
    core_fix_step(o, fixed);
    core_fix_estimate(o, fixed + FIXED_STEP);
}

void kernel_init(const double *open, const double *y, const double *t, double *state)
{
    real o[SOME(OPEN)], measured[SOME(MEASURED)], at[1], s[STATE];
    load(o, open, OPEN);
    load(measured, y, MEASURED);
    load(at, t, 1);
    core_init(o, measured, at[0], s);
    store(state, s, STATE);
}

void kernel_run(const double *open, double *state, const long *rows, const double *const *logs,
                const int *kept, int count, double *const *found)
{
    real o[SOME(OPEN)], d[SOME(FIXED)], s[STATE], u[SOME(INPUTS)], y[SOME(MEASURED)], dt[1];
    real next[STATE + INFO], x[SOME(ESTIMATE)];
    long r, longest = 0;
    int i, k;
    TINY_IS_ZERO;
    load(o, open, OPEN);
    fix(o, d);
    load(s, state, STATE);
    for (i = 0; i < LANES; ++i)
        longest = rows[i] > longest ? rows[i] : longest;
    for (r = 0; r < longest; ++r) {
        for (i = 0; i < LANES; ++i) {
            const long at = r < rows[i] ? r : rows[i] - 1; /* a lane at its end does the last row again, for nobody */
            for (k = 0; k < INPUTS; ++k)
                LANE(u, k, i) = logs[3 * i][at * INPUTS + k];
            for (k = 0; k < MEASURED; ++k)
                LANE(y, k, i) = logs[3 * i + 1][at * MEASURED + k];
            LANE(dt, 0, i) = logs[3 * i + 2][at];
        }
        core_step(d, s, u, y, dt[0], next);
        memcpy(s, next, sizeof s);
        core_estimate(d + FIXED_STEP, s, x);
        for (i = 0; i < LANES; ++i)
            if (r < rows[i]) {
                for (k = 0; k < ESTIMATE; ++k)
                    found[2 * i][r * ESTIMATE + k] = LANE(x, k, i);
                for (k = 0; k < count; ++k)
                    found[2 * i + 1][r * count + k] = LANE(next, STATE + kept[k], i);
            }
    }
    store(state, s, STATE);
    AS_BEFORE;
}

#if LANES == 1
int kernel_fixed(void)
{
    return FIXED;
}

void kernel_fix(const double *open, double *fixed)
{
    fix(open, fixed);
}

int kernel_step(double *numbers, double dt)
{
    double *u = numbers + STATE, *y = u + INPUTS, *x = y + MEASURED, *info = x + ESTIMATE;
    const double *fixed = info + INFO;
    double next[STATE + INFO];
    TINY_IS_ZERO;
    core_step(fixed, numbers, u, y, dt, next);
    memcpy(numbers, next, STATE * sizeof(double));
    memcpy(info, next + STATE, INFO * sizeof(double));
    core_estimate(fixed + FIXED_STEP, numbers, x);
    AS_BEFORE;
    return (int)info[RESULT];
}
#endif
