/* Self-test of xNAMEx. xSENTENCEx */

#include "xNAMEx.h"

#include <math.h>
#include <stdio.h>

#define ROWS xROWSx
#define NUMBERS xNUMBERSx

static const xNAMEx_real start[xMEASUREMENTSx] = {xSTARTx};

static const xNAMEx_real steps[ROWS] = {xSTEPSx};

/* xINPUT_ROWSx */

/* xMEASURED_ROWSx */

static const unsigned char missing[ROWS][xMEASUREMENTSx] = {
    /* xMISSINGx */
};

/* xEXPECTEDx */

/* Ten times what roundings at random make of the same run. */
/* xALLOWEDx */

/* The outcome of each step, or -1 where rounding decides it. */
static const int outcomes[ROWS] = {xOUTCOMESx};

/* Options may let a compiler assume that no number is NaN. Then comparisons with NaN fail, in the observer and here. */
static int sees_nan(void)
{
    volatile xNAMEx_real unknown = (xNAMEx_real)NAN; /* volatile, so that no compiler knows its value */
    const xNAMEx_real seen = unknown;
    xNAMEx_real first[xMEASUREMENTSx];
    xNAMEx_state state;
    int i;

    for (i = 0; i < xMEASUREMENTSx; ++i)
        first[i] = start[i];
    first[0] = seen;
    return seen != seen && xNAMEx_init(&state, &xNAMEx_default, first, xZEROx) == xUPPERx_NOT_FINITE;
}

int main(void)
{
    xNAMEx_state state;
    xNAMEx_output output;
    xNAMEx_real found[NUMBERS], worst = xZEROx;
    int row, i, wrong = xNAMEx_init(&state, &xNAMEx_default, start, xZEROx) != xUPPERx_OK;

    if (!sees_nan()) {
        printf("xNAMEx: WRONG, NaN is not seen as NaN: compile xNAMEx.c and this file without -ffast-math and "
               "-ffinite-math-only\n");
        return 1;
    }
    for (row = 0; row < ROWS; ++row) {
        const int outcome =
            xNAMEx_step(&state, &xNAMEx_default, inputs[row], measured[row], missing[row], steps[row]);
        if (outcomes[row] >= 0 && outcome != outcomes[row]) {
            printf("row %d: outcome %d in place of %d\n", row, outcome, outcomes[row]);
            wrong = 1;
        }
        xNAMEx_estimate(&state, &xNAMEx_default, &output);
        /* xREADx */
        for (i = 0; i < NUMBERS; ++i) {
            const xNAMEx_real off = found[i] > expected[row][i] ? found[i] - expected[row][i]
                                                                : expected[row][i] - found[i];
            const xNAMEx_real part = off / allowed[row][i];
            if (expected[row][i] != expected[row][i])
                continue; /* not known there, nor compared */
            if (!(part <= 1)) {
                printf("row %d: number %d is %.17g in place of %.17g\n", row, i, (double)found[i],
                    (double)expected[row][i]);
                wrong = 1;
            }
            if (worst == worst && !(part <= worst))
                worst = part; /* once NaN, it stays NaN */
        }
    }
    printf("xNAMEx: %s, %d steps, largest deviation %.3f of the allowed one\n", wrong ? "WRONG" : "ok", ROWS,
        (double)worst);
    return wrong;
}
