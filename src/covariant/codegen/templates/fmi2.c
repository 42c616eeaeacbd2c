/* References of real variables are places in the numbers; the whole number 0 is the outcome. */

EXPORT const char *fmi2GetVersion(void)
{
    return "2.0";
}

EXPORT const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

EXPORT void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
    const void *functions, int visible, int logging)
{
    (void)name, (void)resources, (void)functions, (void)visible, (void)logging;
    return type == 1 ? instance(token) : NULL; /* 1 is co-simulation */
}

EXPORT int fmi2SetDebugLogging(void *m, int on, size_t categories, const char *const *names)
{
    (void)on, (void)categories, (void)names;
    return m != NULL ? OK : ERROR;
}

EXPORT int fmi2SetupExperiment(void *m, int defined, double tolerance, double start, int stops, double stop)
{
    (void)defined, (void)tolerance, (void)stops, (void)stop;
    if (m == NULL)
        return ERROR;
    ((memory *)m)->now = start;
    return OK;
}

EXPORT int fmi2EnterInitializationMode(void *m)
{
    return m != NULL ? OK : ERROR;
}

EXPORT int fmi2GetReal(void *m, const uint32_t *references, size_t n, double *values)
{
    size_t i;
    for (i = 0; m != NULL && i < n; ++i) {
        if (references[i] >= NUMBERS)
            return ERROR;
        values[i] = ((const memory *)m)->numbers[references[i]];
    }
    return m != NULL ? OK : ERROR;
}

EXPORT int fmi2SetReal(void *m, const uint32_t *references, size_t n, const double *values)
{
    size_t i;
    for (i = 0; m != NULL && i < n; ++i) {
        if (references[i] >= OUTPUTS)
            return ERROR;
        ((memory *)m)->numbers[references[i]] = values[i];
    }
    return m != NULL ? OK : ERROR;
}

EXPORT int fmi2GetInteger(void *m, const uint32_t *references, size_t n, int *values)
{
    size_t i;
    for (i = 0; m != NULL && i < n; ++i) {
        if (references[i] != 0)
            return ERROR;
        values[i] = ((const memory *)m)->outcome;
    }
    return m != NULL ? OK : ERROR;
}

EXPORT int fmi2DoStep(void *m, double t, double h, int forward)
{
    (void)forward;
    return m != NULL ? advance(m, t, h) : ERROR;
}

