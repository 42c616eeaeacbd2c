/* The same step where nothing but the xCOUNTx numbers of xPARTx were read, with less work. */
int xNAMEx_xSTEPx(xNAMEx_state *state, const xNAMEx_params *params, const xNAMEx_real *u,
    const xNAMEx_real *y, xNAMEx_real dt);
