/* The observer xNAMEx as a functional mock-up unit, of which its own header and source know nothing. */
#include "xNAMEx.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

#define TOKEN "xTOKENx"
#define NUMBERS xNUMBERSx /* measurement, input, parameters, then outputs */
#define INPUTS xINPUTSx
#define OUTPUTS xOUTPUTSx /* where they begin */

enum { OK = 0, ERROR = 3 };

/* All of an instance; a copy is a snapshot. */
typedef struct {
    double numbers[NUMBERS];
    xNAMEx_real acted[xUPPERx_INPUTS + 1]; /* the input since the last measurement */
    xNAMEx_state state;                    /* after the last measurement, at the time t */
    double t, now;
    int32_t started, stepped, outcome;
} memory;

static void take(const memory *m, xNAMEx_params *params)
{
    /* xTAKENx */
}

static void show(memory *m, const xNAMEx_output *output)
{
    /* xSHOWNx */
}

static void forget(memory *m)
{
    int i;
    memset(m, 0, sizeof *m);
    /* xSTARTx */
    for (i = OUTPUTS; i < NUMBERS; ++i)
        m->numbers[i] = NAN;
}

static void tell(memory *m, const xNAMEx_state *state, const xNAMEx_params *params)
{
    xNAMEx_output output;
    xNAMEx_estimate(state, params, &output);
    show(m, &output);
}

/* The input from now on. */
static void act(memory *m)
{
    int i;
    for (i = 0; i < xUPPERx_INPUTS; ++i)
        m->acted[i] = (xNAMEx_real)m->numbers[xUPPERx_MEASUREMENTS + i];
}

/* Start at the measurement, where it is complete. */
static void begin(memory *m, double t)
{
    xNAMEx_params params;
    xNAMEx_real y[xUPPERx_MEASUREMENTS];
    int i;
    for (i = 0; i < xUPPERx_MEASUREMENTS; ++i)
        y[i] = (xNAMEx_real)m->numbers[i];
    take(m, &params);
    m->outcome = xNAMEx_init(&m->state, &params, y, (xNAMEx_real)t);
    m->started = m->outcome == xUPPERx_OK;
    if (!m->started)
        m->outcome = xUPPERx_COASTED;
    m->t = m->now = t;
    if (m->started && xAT_ENDx) {
        act(m);
        (void)xNAMEx_step(&m->state, &params, m->acted, y, NULL, 0);
    }
    if (m->started)
        tell(m, &m->state, &params);
}

/* From t to t + h: the measurement is of the time t, where it corrects; the outputs are predicted to t + h. */
static int advance(memory *m, double t, double h)
{
    xNAMEx_params params;
    xNAMEx_state ahead;
    xNAMEx_real y[xUPPERx_MEASUREMENTS];
    unsigned char missing[xUPPERx_MEASUREMENTS];
    int i;
    /* After a step from or to a time that is not finite, no time would count as later, and nothing would correct. */
    if (!(h >= 0) || !(t + h - (t + h) == 0))
        return ERROR;
    take(m, &params);
    for (i = 0; i < xUPPERx_MEASUREMENTS; ++i) {
        y[i] = (xNAMEx_real)m->numbers[i];
        missing[i] = 1;
    }
    if (!m->started || !m->stepped) {
        begin(m, t);
    } else {
        if (xAT_ENDx) /* the input of a step is that of its end */
            act(m);
        /* A step of length zero and one back in time leave the state as it was, and the outcome says so. */
        m->outcome = xNAMEx_step(&m->state, &params, m->acted, y, NULL, (xNAMEx_real)(t - m->t));
        m->started = m->outcome != xUPPERx_NOT_FINITE;
        m->t = t > m->t ? t : m->t;
    }
    m->stepped = m->started;
    m->now = t + h;
    act(m);
    if (!m->started)
        return OK;
    ahead = m->state;
    if (h > 0 && xNAMEx_step(&ahead, &params, m->acted, y, missing, (xNAMEx_real)h) == xUPPERx_NOT_FINITE) {
        /* The prediction is not finite: the outputs stay those of the time t. */
        ahead = m->state;
        m->outcome = xUPPERx_NOT_FINITE;
    }
    tell(m, &ahead, &params);
    return OK;
}

static void *snapshot(const memory *m, void *place)
{
    memory *copy = place != NULL ? place : malloc(sizeof *copy);
    if (copy != NULL)
        *copy = *m;
    return copy;
}

static memory *instance(const char *token)
{
    memory *m = token != NULL && strcmp(token, TOKEN) == 0 ? malloc(sizeof *m) : NULL;
    if (m != NULL)
        forget(m);
    return m;
}

EXPORT void xFMIxFreeInstance(void *m)
{
    free(m);
}

EXPORT int xFMIxExitInitializationMode(void *m)
{
    if (m == NULL)
        return ERROR;
    begin(m, ((memory *)m)->now);
    return OK;
}

EXPORT int xFMIxTerminate(void *m)
{
    return m != NULL ? OK : ERROR;
}

EXPORT int xFMIxReset(void *m)
{
    if (m == NULL)
        return ERROR;
    forget(m);
    return OK;
}

EXPORT int xFMIxGetFMUxSTATEx(void *m, void **state)
{
    if (m == NULL || state == NULL)
        return ERROR;
    *state = snapshot(m, *state);
    return *state != NULL ? OK : ERROR;
}

EXPORT int xFMIxSetFMUxSTATEx(void *m, void *state)
{
    return m != NULL && state != NULL && snapshot(state, m) != NULL ? OK : ERROR;
}

EXPORT int xFMIxFreeFMUxSTATEx(void *m, void **state)
{
    (void)m;
    if (state == NULL)
        return OK;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT int xFMIxSerializedFMUxSTATExSize(void *m, void *state, size_t *size)
{
    (void)m, (void)state;
    *size = sizeof(memory);
    return OK;
}

EXPORT int xFMIxSerializeFMUxSTATEx(void *m, void *state, xBYTEx *bytes, size_t size)
{
    (void)m;
    if (state == NULL || size != sizeof(memory))
        return ERROR;
    memcpy(bytes, state, size);
    return OK;
}

EXPORT int xFMIxxDExFMUxSTATEx(void *m, const xBYTEx *bytes, size_t size, void **state)
{
    (void)m;
    if (size != sizeof(memory) || state == NULL || (*state == NULL && (*state = malloc(size)) == NULL))
        return ERROR;
    memcpy(*state, bytes, size);
    return OK;
}

