int xNAMEx_xSTEPx(xNAMEx_state *state, const xNAMEx_params *params, const xNAMEx_real *u,
    const xNAMEx_real *y, xNAMEx_real dt)
{
    /* xNO_INPUTx */
    xNAMEx_state next;
    xNAMEx_real result;
    xNAMEx_core_xSTEPx(params, state, xACTINGx, y, dt, &next, &result);
    *state = next;
    return (int)result;
}
