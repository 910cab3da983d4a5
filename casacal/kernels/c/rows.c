/* Residuals, slopes, costs and normal equations of rows: samples innermost, sums where the Jacobian is made. */
#include "errors.h"

/* What depends on parameters alone, of residuals and slopes, to o[value]. */
static void prepare_slopes(long states, const double *restrict p, double *restrict o)
{
#pragma omp simd
    for (long s = 0; s < states; s++) {
        PREPARE_SLOPES
    }
}

/* Upper triangle of A A' for ROWS rows of PART numbers, added to S: two by four rows at a time. */
static void gram(const double *restrict a, double *restrict s)
{
    for (long i = 0; i < ROWS; i += 2)
        for (long j = i & ~3L; j < ROWS; j += 4) {
            wide sum[2][4] = {{{0}}};
            for (long k = 0; k < PART; k += WIDE) {
                wide x[2], y[4];
                for (int m = 0; m < 2; m++) x[m] = *(const wide *)(a + (i + m) * PART + k);
                for (int m = 0; m < 4; m++) y[m] = *(const wide *)(a + (j + m) * PART + k);
                for (int m = 0; m < 2; m++)
                    for (int n = 0; n < 4; n++) sum[m][n] += x[m] * y[n];
            }
            for (int m = 0; m < 2; m++)
                for (int n = 0; n < 4; n++) {
                    double total = 0.0;
                    for (int k = 0; k < WIDE; k++) total += sum[m][n][k];
                    s[(i + m) * ROWS + j + n] += total;
                }
        }
}

/* Slopes and, last, residual of each of COMPONENTS components, times its weight w[m][distance]: a[m][ROWS][PART]. */
static void fill(long lanes, long ld, const double *restrict o, const double *restrict d, long distance,
                 const double *restrict w, double *restrict a)
{
    const long stride = 1;
    READ_SLOPES
    lanes = padded(lanes);
#pragma omp simd
    for (long i = 0; i < lanes; i++) {
        LANE_OF_SLOPES
    }
}

/* Lanes to where they belong in memory; a large result is written around the caches, which it would only empty. */
static void put(long lanes, const double *restrict from, double *restrict to, long large)
{
    lanes = padded(lanes);
    if (large) {
#if defined(__AVX__) && defined(__GNUC__) && !defined(__clang__)
        typedef double four __attribute__((vector_size(32)));
        for (long i = 0; i < lanes; i += 4) __builtin_ia32_movntpd256(to + i, *(const four *)(from + i));
        return;
#elif defined(__clang__)
        for (long i = 0; i < lanes; i += 4)
            __builtin_nontemporal_store(*(const wide *)(from + i), (wide *)(to + i));
        return;
#endif
    }
    for (long i = 0; i < lanes; i++) to[i] = from[i];
}

/* Residuals e[m][lane]. */
void residual(long n, long ld, const double *restrict p, const double *restrict d, double *restrict e)
{
    double o[ERRORS_PREPARED];
    prepare_errors(1, p, o);
    errors(n, ld, 1, o, d, ld, e);
}

/* Residuals e[m][lane] and slopes j[m * z][lane]. */
void slopes(long n, long ld, const double *restrict p, const double *restrict d, double *restrict e,
            double *restrict j, long large)
{
    double a[COMPONENTS * ROWS * PART] __attribute__((aligned(64))), o[SLOPES_PREPARED], ones[PART];
    for (long i = 0; i < PART; i++) ones[i] = 1.0;
    prepare_slopes(1, p, o);
    for (long first = 0; first < n; first += PART) {
        const long lanes = n - first < PART ? n - first : PART;
        fill(lanes, ld, o, d + first, 0, ones, a);
        for (long m = 0; m < COMPONENTS; m++) {
            const double *row = a + m * ROWS * PART;
            double *to = j + m * UNKNOWNS * ld + first;
            for (long k = 0; k < UNKNOWNS; k++) put(lanes, row + k * PART, to + k * ld, large);
            put(lanes, row + UNKNOWNS * PART, e + m * ld + first, 0);
        }
    }
}

/* Half the sum of squares of w e at each of `states` parameter vectors, added to cost[state]. */
void costs(long n, long ld, long states, const double *restrict p, const double *restrict d, const double *restrict w,
           double *restrict cost)
{
    double e[COMPONENTS * PART] __attribute__((aligned(64))), o[ERRORS_PREPARED * STATES], turned[PARAMETERS * STATES];
    for (long begun = 0; begun < states; begun += STATES) {
        const long count = states - begun < STATES ? states - begun : STATES;
        for (long s = 0; s < count; s++)
            for (long k = 0; k < PARAMETERS; k++) turned[k * count + s] = p[(begun + s) * PARAMETERS + k];
        prepare_errors(count, turned, o);
        for (long s = 0; s < count; s++) {
            double total = 0.0;
            for (long first = 0; first < n; first += PART) {
                const long lanes = padded(n - first < PART ? n - first : PART);
                errors(lanes, ld, count, o + s, d + first, PART, e);
                for (long m = 0; m < COMPONENTS; m++) {
                    const double *weight = w + m * ld + first;
#pragma omp simd reduction(+ : total)
                    for (long i = 0; i < lanes; i++) {
                        const double r = weight[i] * e[m * PART + i];
                        total += r * r;
                    }
                }
            }
            cost[begun + s] += 0.5 * total;
        }
    }
}

/* Weighted normal matrix of slopes and, last, residual, to s[ROWS][ROWS]. */
void normal(long n, long ld, const double *restrict p, const double *restrict d, const double *restrict w,
            double *restrict s)
{
    double a[COMPONENTS * ROWS * PART] __attribute__((aligned(64))), o[SLOPES_PREPARED];
    prepare_slopes(1, p, o);
    for (long k = 0; k < ROWS * ROWS; k++) s[k] = 0.0;
    for (long k = 0; k < COMPONENTS * ROWS * PART; k++) a[k] = 0.0;
    for (long first = 0; first < n; first += PART) {
        const long lanes = n - first < PART ? n - first : PART;
        fill(lanes, ld, o, d + first, ld, w + first, a);
        if (first && lanes < PART)
            for (long r = 0; r < COMPONENTS * ROWS; r++)
                for (long k = lanes; k < PART; k++) a[r * PART + k] = 0.0;
        for (long m = 0; m < COMPONENTS; m++) gram(a + m * ROWS * PART, s);
    }
    for (long i = 1; i < ROWS; i++)
        for (long k = 0; k < i; k++) s[i * ROWS + k] = s[k * ROWS + i];
}
