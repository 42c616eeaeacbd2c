/* gcc's elimination of partial redundancies turns choices into branches, which cannot be vectors. */
#if defined __GNUC__ && !defined __clang__
#pragma GCC optimize("no-tree-pre")
#endif

/* xHEADx */
#define LANES xLANESx

/* xKERNELSx */
static void (*const kernels[])(double *, const int32_t *) = {xPOINTERSx};
static const int widths[] = {xWIDTHSx};

void enclose(const int32_t *steps, int64_t count, double *w, const int32_t *inputs, int64_t n_inputs,
             const int32_t *outputs, int64_t n_outputs, int64_t boxes, const double *ends, double *found)
{
    int64_t box, k, i;
    for (box = 0; box < boxes; box += LANES) {
        const int64_t left = boxes - box < LANES ? boxes - box : LANES;
        const int32_t *at = steps;
        for (k = 0; k < n_inputs; ++k)
            for (i = 0; i < LANES; ++i)
                w[inputs[k] + i] = ends[k * boxes + box + (i < left ? i : left - 1)];
        for (k = 0; k < count; ++k) {
            kernels[at[0]](w, at + 1);
            at += 1 + widths[at[0]];
        }
        for (k = 0; k < n_outputs; ++k)
            for (i = 0; i < left; ++i)
                found[k * boxes + box + i] = w[outputs[k] + i];
    }
}
