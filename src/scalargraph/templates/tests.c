#define LANES xLANESx
#define ROUND xROUNDx
#define TINY xTINYx
#define MOST xMOSTx

#include <math.h>
#include <stdint.h>

#define EACH for (i = 0; i < lanes; ++i)
#define LARGER(a, b) ((b) != (b) || (b) > (a) ? (b) : (a))
#define KNOWN_LARGER(a, b) ((b) != (b) || (a) >= (b) ? (a) : (b))
#define KNOWN_SMALLER(a, b) ((b) != (b) || (a) <= (b) ? (a) : (b))
#define MIDDLE(a, b) ((a) / 2.0 + (b) / 2.0)

typedef double lane[LANES];

static void ball(int lanes, const double *restrict low, const double *restrict high, double *restrict middle,
                 double *restrict radius)
{
    int i;
    EACH {
        const double m = MIDDLE(low[i], high[i]), up = high[i] - m, down = m - low[i];
        middle[i] = m;
        radius[i] = LARGER(up, down) * (1.0 + ROUND) + TINY;
    }
}

static double outward(double x, double sign)
{
    return x + sign * (fabs(x) * ROUND + TINY);
}

/* One entry of the matrix: a column of numbers with k columns a row and so many boxes a number. */
static void entry(int lanes, int64_t k, int64_t f, int64_t boxes, const double *al, const double *ah, const double *ol,
                  const double *oh, const double *half, const double *smooth, double *centre, double *terms,
                  double *rest, double *middle, double *radius, double *shares)
{
    lane value, around, m, r, bent, squares, sizes, wide, spread;
    const int64_t row = k * boxes;
    int64_t v, u, p = f;
    int i;
    ball(lanes, al, ah, value, around);
    EACH bent[i] = squares[i] = sizes[i] = wide[i] = spread[i] = 0.0;
    for (v = 0; v < f; ++v) {
        const int64_t at = (1 + v) * row, to = v * row;
        const double *h = half + v * boxes;
        ball(lanes, al + at, ah + at, m, r);
        EACH {
            const double t = m[i] * h[i], s = r[i] * h[i], a = fabs(ol[at + i]), b = fabs(oh[at + i]);
            terms[to + i] = t;
            shares[to + i] = s;
            sizes[i] += fabs(t);
            spread[i] += s;
            wide[i] += LARGER(a, b) * h[i];
        }
    }
    for (v = 0; v < f; ++v)
        for (u = v; u < f; ++u, ++p) {
            const int64_t at = (1 + p) * row, to = p * row;
            const double *g = half + v * boxes, *h = half + u * boxes, over = u == v ? 2.0 : 1.0;
            const double part = u == v ? 0.5 : 1.0, square = u == v ? 1.0 : 0.0;
            ball(lanes, ol + at, oh + at, m, r);
            EACH {
                const double size = g[i] * h[i] / over, t = m[i] * (size * part), s = r[i] * (size * (1.0 + ROUND));
                terms[to + i] = t;
                shares[to + i] = s;
                sizes[i] += fabs(t);
                bent[i] += fabs(t);
                squares[i] += square != 0.0 ? t : 0.0;
                spread[i] += s;
            }
        }
    EACH {
        const double moved = value[i] + squares[i];
        const double off = around[i] + ROUND * (fabs(value[i]) + bent[i]);
        const double most = smooth[i] != 0.0 ? (off + spread[i]) * (1.0 + ROUND) + TINY : INFINITY;
        const double far = smooth[i] != 0.0 ? around[i] + wide[i] * (1.0 + ROUND) : INFINITY;
        const double reach = most + sizes[i] * (1.0 + ROUND);
        const double low = outward(moved - reach, -1.0), high = outward(moved + reach, 1.0);
        const double lower = KNOWN_LARGER(low, ol[i]), upper = KNOWN_SMALLER(high, oh[i]);
        const double below = outward(value[i] - far, -1.0), above = outward(value[i] + far, 1.0);
        const double least = KNOWN_LARGER(lower, below), largest = KNOWN_SMALLER(upper, above);
        const double half_way = MIDDLE(least, largest), up = largest - half_way, down = half_way - least;
        centre[i] = moved;
        rest[i] = most;
        middle[i] = half_way;
        radius[i] = LARGER(up, down) * (1.0 + ROUND) + TINY;
    }
}

void taylor(int64_t k, int64_t f, int64_t boxes, const double *al, const double *ah, const double *ol,
            const double *oh, const double *half, const double *smooth, double *centre, double *terms, double *rest,
            double *middle, double *radius, double *shares)
{
    int64_t box, e;
    for (box = 0; box < boxes; box += LANES)
        for (e = 0; e < k; ++e) {
            const int64_t at = e * boxes + box;
            entry(boxes - box < LANES ? (int)(boxes - box) : LANES, k, f, boxes, al + at, ah + at, ol + at, oh + at,
                  half + box, smooth + box, centre + at, terms + at, rest + at, middle + at, radius + at, shares + at);
        }
}

static int64_t place(int64_t i, int64_t j)
{
    return i >= j ? i * (i + 1) / 2 + j : j * (j + 1) / 2 + i;
}

/* The entries of C'SC on and below the diagonal. */
static void congruent(int lanes, int64_t n, lane *c, lane *s, lane *column, lane *found)
{
    int64_t a, b, j, l;
    int i;
    for (b = 0; b < n; ++b) {
        for (l = 0; l < n; ++l) {
            double *restrict sum = column[l];
            for (j = 0; j < n; ++j) {
                const double *restrict x = s[place(l, j)], *restrict y = c[j * n + b];
                if (j)
                    EACH sum[i] += x[i] * y[i];
                else
                    EACH sum[i] = x[i] * y[i];
            }
        }
        for (a = b; a < n; ++a) {
            double *restrict sum = found[place(a, b)];
            for (l = 0; l < n; ++l) {
                const double *restrict x = column[l], *restrict y = c[l * n + a];
                if (l)
                    EACH sum[i] += x[i] * y[i];
                else
                    EACH sum[i] = x[i] * y[i];
            }
        }
    }
}

static void times(int lanes, int64_t n, lane *e, lane *x, lane *found)
{
    int64_t a, b;
    int i;
    for (a = 0; a < n; ++a)
        for (b = 0; b < n; ++b) {
            const double *restrict p = e[place(a, b)], *restrict q = x[b];
            double *restrict sum = found[a];
            if (b)
                EACH sum[i] += p[i] * q[i];
            else
                EACH sum[i] = p[i] * q[i];
        }
}

void definite(int64_t n, int64_t m, int64_t boxes, const double *factors, const double *middle, const double *radius,
              const double *terms, double *below)
{
    const int64_t k = n * (n + 1) / 2;
    lane c[n * n], absolute[n * n], s[k], e[k], turned[k], sum[k], size[k], column[n], x[n], y[n], good, top;
    int64_t box, j, a, b, t;
    int i;
    for (box = 0; box < boxes; box += LANES) {
        const int lanes = boxes - box < LANES ? (int)(boxes - box) : LANES;
        for (j = 0; j < n * n; ++j)
            EACH {
                c[j][i] = factors[j * boxes + box + i];
                absolute[j][i] = fabs(c[j][i]);
            }
        for (j = 0; j < k; ++j)
            EACH {
                s[j][i] = middle[j * boxes + box + i];
                sum[j][i] = size[j][i] = 0.0;
            }
        congruent(lanes, n, c, s, column, e);
        for (a = 0; a < n; ++a)
            for (b = 0; b <= a; ++b)
                EACH e[place(a, b)][i] = fabs((a == b ? 1.0 : 0.0) - e[place(a, b)][i]);
        for (t = 0; t < m; ++t) {
            for (j = 0; j < k; ++j)
                EACH s[j][i] = terms[(t * k + j) * boxes + box + i];
            congruent(lanes, n, c, s, column, turned);
            for (j = 0; j < k; ++j)
                EACH {
                    sum[j][i] += fabs(turned[j][i]);
                    size[j][i] += fabs(s[j][i]);
                }
        }
        for (j = 0; j < k; ++j)
            EACH {
                const double here = fabs(middle[j * boxes + box + i]);
                e[j][i] += sum[j][i];
                s[j][i] = radius[j * boxes + box + i] + ROUND * (here + size[j][i]);
            }
        congruent(lanes, n, absolute, s, column, turned);
        for (j = 0; j < k; ++j)
            EACH e[j][i] = (e[j][i] + turned[j][i]) * (1.0 + ROUND) + ROUND;
        for (a = 0; a < n; ++a)
            EACH x[a][i] = 1.0;
        for (t = 0; t < 4; ++t) {
            times(lanes, n, e, x, y);
            for (a = 0; a < n; ++a)
                EACH {
                    x[a][i] = y[a][i] + 1e-6;
                    top[i] = a ? LARGER(top[i], x[a][i]) : x[a][i];
                }
            for (a = 0; a < n; ++a)
                EACH x[a][i] /= top[i];
        }
        times(lanes, n, e, x, y);
        EACH good[i] = 1.0;
        for (a = 0; a < n; ++a)
            EACH good[i] = y[a][i] * (1.0 + ROUND) + TINY <= MOST * x[a][i] ? good[i] : 0.0;
        EACH below[box + i] = good[i];
    }
}

void weights(int64_t n, int64_t m, int64_t boxes, const double *factors, const double *terms, const double *shares,
             double *found)
{
    const int64_t k = n * (n + 1) / 2;
    lane c[n * n], width[n], s[k], turned[k], column[n];
    int64_t box, j, a, b, t;
    int i;
    for (box = 0; box < boxes; box += LANES) {
        const int lanes = boxes - box < LANES ? (int)(boxes - box) : LANES;
        for (j = 0; j < n * n; ++j)
            EACH c[j][i] = factors[j * boxes + box + i];
        for (a = 0; a < n; ++a)
            for (b = 0; b < n; ++b)
                EACH width[a][i] = fabs(c[a * n + b][i]) + (b ? width[a][i] : 0.0);
        for (t = 0; t < m; ++t) {
            double *to = found + t * boxes + box;
            for (j = 0; j < k; ++j)
                EACH s[j][i] = terms[(t * k + j) * boxes + box + i];
            congruent(lanes, n, c, s, column, turned);
            EACH to[i] = 0.0;
            for (a = 0; a < n; ++a)
                for (b = 0; b <= a; ++b) {
                    const int64_t p = place(a, b);
                    const double *share = shares + (t * k + p) * boxes + box;
                    const double times = a == b ? 1.0 : 2.0;
                    EACH to[i] += (fabs(turned[p][i]) + share[i] * (width[a][i] * width[b][i])) * times;
                }
        }
    }
}
