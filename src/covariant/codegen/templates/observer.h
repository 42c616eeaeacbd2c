/* xABOUTx
 *
 * Written by covariant xVERSIONx. xSENTENCEx
 */
#ifndef xUPPERx_H
#define xUPPERx_H

#ifdef __cplusplus
extern "C" {
#endif

typedef xREALx xNAMEx_real;

/* xSIGNALSx */
#define xUPPERx_MEASUREMENTS xMEASUREMENTSx /* xMEASUREDx */
#define xUPPERx_INPUTS xINPUTSx

/* Outcome of a step; a larger one is worse. */
enum {
    /* xCODESx */
};

/* Numbers that may be changed at any time, between two steps. */
typedef struct {
    /* xPARAMSx */
} xNAMEx_params;

/* What is remembered; a copy is a snapshot. Innovation and standard deviations are of the last step. */
typedef struct {
    /* xSTATEx */
} xNAMEx_state;

/* An estimate. */
typedef struct {
    /* xOUTPUTx */
} xNAMEx_output;

extern const xNAMEx_params xNAMEx_default;

/* Start at rest at the measurement y, at the time t [s]. Returns xUPPERx_OK, or another outcome where nothing
 * starts, and then leaves the state as it was: xUPPERx_NOT_FINITE where xSTARTEDx is not all finite, or is a
 * matrix and no rotation, and xUPPERx_COASTED where a number is too large to tell a place. */
int xNAMEx_init(xNAMEx_state *state, const xNAMEx_params *params, const xNAMEx_real *y, xNAMEx_real t);

/* Advance by dt [s] under the input u, then correct by the measurement y.
 *
 * missing: for each number of y, 1 where it was not measured; NULL for none. NaN in y says the same.
 * u: xSENTx; NULL counts as zero. One that is not finite is replaced by the last one.
 * dt: the time since the last stamp that was used. A step that is not positive leaves the state as it was.
 * A state that left the finite numbers, as after a u of 1e200, is replaced by a start at y, or, where that is not
 * complete, by the state before: xUPPERx_NOT_FINITE.
 *
 * The outcome says what of this happened. Call xNAMEx_init first: a state without it has no meaning. */
int xNAMEx_step(xNAMEx_state *state, const xNAMEx_params *params, const xNAMEx_real *u,
    const xNAMEx_real *y, const unsigned char *missing, xNAMEx_real dt);

/* xPART_STEPSx */
/* The estimate of a state. */
void xNAMEx_estimate(const xNAMEx_state *state, const xNAMEx_params *params, xNAMEx_output *output);

#ifdef __cplusplus
}
#endif

#endif
