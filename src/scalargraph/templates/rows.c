#include <math.h>

/* xHELPERSx */
/* xCOREx */
void xNAMEx(const xREALx *x, xREALx *y, long long count);
void xNAMEx(const xREALx *x, xREALx *y, long long count)
{
    lanes in[xINPUTSx], out[xOUTPUTSx];
    long long row;
    int i, k;
    for (row = 0; row < count; row += xLANESx) {
        const int left = count - row < xLANESx ? (int)(count - row) : xLANESx;
        for (i = 0; i < xLANESx; ++i)
            for (k = 0; k < xINPUTSx; ++k)
                in[k][i] = x[(row + (i < left ? i : left - 1)) * xINPUTSx + k];
        xNAMEx_lanes(in, out);
        for (i = 0; i < left; ++i)
            for (k = 0; k < xOUTPUTSx; ++k)
                y[(row + i) * xOUTPUTSx + k] = out[k][i];
    }
}
