/* Rows of a log through xNAMEx, for callers that hold a log as arrays. xSENTENCEx */
#include "xNAMEx.h"

#include <stddef.h>

/* Of which texts this library was built. */
const char xNAMEx_token[] = "xTOKENx";

/* Steps through all rows; u, y, dt and what is written lie row by row. */
void xNAMEx_rows(xNAMEx_state *state, const xNAMEx_params *params, size_t rows, const xNAMEx_real *u,
    const xNAMEx_real *y, const xNAMEx_real *dt, xNAMEx_output *outputs, xNAMEx_real *reported, int *results)
{
    /* A state has nothing but numbers of one type, and what a step reports at its end. */
    const xNAMEx_real *last = (const xNAMEx_real *)state + xFIRST_REPORTEDx;
    size_t row, i;

    for (row = 0; row < rows; ++row) {
        results[row] = xNAMEx_step(state, params, u != NULL ? u + row * xUPPERx_INPUTS : NULL,
            y + row * xUPPERx_MEASUREMENTS, NULL, dt[row]);
        xNAMEx_estimate(state, params, outputs + row);
        for (i = 0; i < xREPORTEDx; ++i)
            reported[row * xREPORTEDx + i] = last[i];
    }
}
