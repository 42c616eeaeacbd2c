/* References: 0 is time, 1 the outcome; those of arrays of numbers follow. */
#define VARIABLES xVARIABLESx
static const size_t first[VARIABLES] = {xFIRSTSx}, count[VARIABLES] = {xSIZESx};

EXPORT const char *fmi3GetVersion(void)
{
    return "3.0";
}

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
    bool logging, bool events, bool early, const uint32_t *intermediate, size_t intermediates, void *environment,
    void (*log)(void *, int, const char *, const char *), void (*update)(void))
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early, (void)intermediate;
    (void)intermediates, (void)environment, (void)log, (void)update;
    return instance(token);
}

EXPORT int fmi3SetDebugLogging(void *m, bool on, size_t categories, const char *const *names)
{
    (void)on, (void)categories, (void)names;
    return m != NULL ? OK : ERROR;
}

EXPORT int fmi3EnterInitializationMode(void *m, bool defined, double tolerance, double start, bool stops, double stop)
{
    (void)defined, (void)tolerance, (void)stops, (void)stop;
    if (m == NULL)
        return ERROR;
    ((memory *)m)->now = start;
    return OK;
}

static bool known(uint32_t reference)
{
    return reference >= 2 && reference < VARIABLES + 2;
}

EXPORT int fmi3GetFloat64(void *instance, const uint32_t *references, size_t n, double *values, size_t size)
{
    const memory *m = instance;
    size_t i, k, at = 0;
    for (i = 0; m != NULL && i < n; ++i) {
        const uint32_t r = references[i];
        if ((r != 0 && !known(r)) || at + (r == 0 ? 1 : count[r - 2]) > size)
            return ERROR;
        for (k = 0; k < (r == 0 ? 1 : count[r - 2]); ++k)
            values[at++] = r == 0 ? m->now : m->numbers[first[r - 2] + k];
    }
    return m != NULL && at == size ? OK : ERROR;
}

EXPORT int fmi3SetFloat64(void *instance, const uint32_t *references, size_t n, const double *values, size_t size)
{
    memory *m = instance;
    size_t i, k, at = 0;
    for (i = 0; m != NULL && i < n; ++i) {
        const uint32_t r = references[i];
        if (!known(r) || first[r - 2] >= OUTPUTS || at + count[r - 2] > size)
            return ERROR;
        for (k = 0; k < count[r - 2]; ++k)
            m->numbers[first[r - 2] + k] = values[at++];
    }
    return m != NULL && at == size ? OK : ERROR;
}

EXPORT int fmi3GetInt32(void *instance, const uint32_t *references, size_t n, int32_t *values, size_t size)
{
    size_t i;
    if (instance == NULL || size != n)
        return ERROR;
    for (i = 0; i < n; ++i) {
        if (references[i] != 1)
            return ERROR;
        values[i] = ((const memory *)instance)->outcome;
    }
    return OK;
}

EXPORT int fmi3EnterStepMode(void *m)
{
    return m != NULL ? OK : ERROR;
}

EXPORT int fmi3DoStep(void *m, double t, double h, bool forward, bool *events, bool *terminate, bool *early,
    double *reached)
{
    (void)forward;
    if (m == NULL || advance(m, t, h) != OK)
        return ERROR;
    *events = *terminate = *early = false;
    *reached = t + h;
    return OK;
}

