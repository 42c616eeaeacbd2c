/* xABOUTx
 *
 * Written by covariant xVERSIONx. xSENTENCEx
 */
#include "xNAMEx.h"

#include <math.h>
#include <stddef.h>

#if defined __FAST_MATH__ || defined _M_FP_FAST || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__)
#error missing measurements are NaN: compile this file without -ffast-math, -ffinite-math-only and /fp:fast
#endif

#if defined __cplusplus || (defined _MSC_VER && !defined __STDC_VERSION__)
#define restrict
#elif !defined __STDC_VERSION__ || __STDC_VERSION__ < 199901L
#error this file is C99, or C++: compile it with -std=c99
#endif

/* Where double has four bytes, as on some microcontrollers, export the observer in float. */
typedef char xNAMEx_size_of_real[sizeof(xNAMEx_real) == xSIZEx ? 1 : -1];

const xNAMEx_params xNAMEx_default = {
    /* xDEFAULTSx */
};

/* xHELPERSx */
/* xFUNCTIONSx */
int xNAMEx_init(xNAMEx_state *state, const xNAMEx_params *params, const xNAMEx_real *y, xNAMEx_real t)
{
    static const xNAMEx_real largest[xNEEDEDx] = {xLARGESTx};
    xNAMEx_state first;
    xNAMEx_output output;
    const xNAMEx_real *estimated = (const xNAMEx_real *)&output;
    int i;
    for (i = 0; i < xNEEDEDx; ++i) {
        if (!(y[i] - y[i] == 0))
            return xUPPERx_NOT_FINITE;
    }
    /* In a step such a number counts as missing. */
    for (i = 0; i < xNEEDEDx; ++i) {
        if (y[i] > largest[i] || y[i] < -largest[i])
            return xUPPERx_COASTED;
    }
    xNAMEx_core_init(params, y, t, &first);
    xNAMEx_core_estimate(params, &first, &output);
    /* A matrix that is no rotation starts nothing. */
    for (i = 0; i < xESTIMATEDx; ++i) {
        if (!(estimated[i] - estimated[i] == 0))
            return xUPPERx_NOT_FINITE;
    }
    *state = first;
    /* xUNKNOWNx */
    return xUPPERx_OK;
}

int xNAMEx_step(xNAMEx_state *state, const xNAMEx_params *params, const xNAMEx_real *u,
    const xNAMEx_real *y, const unsigned char *missing, xNAMEx_real dt)
{
    /* xNO_INPUTx */
    xNAMEx_state next;
    xNAMEx_real seen[xMEASUREMENTSx], result;
    int i;
    for (i = 0; i < xUPPERx_MEASUREMENTS; ++i)
        seen[i] = missing != NULL && missing[i] ? (xNAMEx_real)NAN : y[i];
    xNAMEx_core_step(params, state, xACTINGx, seen, dt, &next, &result);
    *state = next;
    return (int)result;
}

/* xPART_STEPSx */
void xNAMEx_estimate(const xNAMEx_state *state, const xNAMEx_params *params, xNAMEx_output *output)
{
    xNAMEx_core_estimate(params, state, output);
    /* xCOPIEDx */
}
