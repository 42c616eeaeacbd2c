/* The observer xNAMEx for JavaScript, which reads and writes its numbers in one place. xSENTENCEx */
#include "xNAMEx.h"

#include <stddef.h>

#define EXPORT(name) __attribute__((export_name(name)))

/* All are numbers of one type, so that they lie one after the other. */
static struct {
    xNAMEx_params params;
    xNAMEx_state state;
    xNAMEx_output output;
    xNAMEx_real y[xUPPERx_MEASUREMENTS], u[xUPPERx_INPUTS + 1];
} all;

EXPORT("place") void *place(void)
{
    return &all;
}

EXPORT("reset") void reset(void)
{
    all.params = xNAMEx_default;
}

EXPORT("start") int start(double t)
{
    return xNAMEx_init(&all.state, &all.params, all.y, (xNAMEx_real)t);
}

EXPORT("step") int step(double dt)
{
    return xNAMEx_step(&all.state, &all.params, all.u, all.y, NULL, (xNAMEx_real)dt);
}

EXPORT("estimate") void estimate(void)
{
    xNAMEx_estimate(&all.state, &all.params, &all.output);
}
