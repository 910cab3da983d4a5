"""What is the same in the C of every program: loops over parts of the lanes, and reductions."""

from __future__ import annotations

from string import Template

HEAD = """
#include <math.h>
#if defined(__AVX512F__)
#define WIDE 8
#else
#define WIDE 4
#endif
#define PART 128  /* lanes at a time: what they need stays in the nearest cache */
#define STATES 16 /* parameter vectors prepared at a time */
typedef double wide __attribute__((vector_size(8 * WIDE)));

/* Under names that the compiler does not know as sine and cosine, it does not merge them into one call that it cannot
   vectorise; the names in the library, and its forms for several lanes, are the usual ones. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
double lane_sin(double) __asm__("sin") __attribute__((const, simd("notinbranch")));
double lane_cos(double) __asm__("cos") __attribute__((const, simd("notinbranch")));
#else
#define lane_sin sin
#define lane_cos cos
#endif

/* Lanes are padded to a multiple of eight, so a loop over them needs no tail. */
static long padded(long lanes) { return (lanes + 7) & ~7L; }
"""

PREPARE = Template("""
/* What depends on parameters alone, of each of `states` vectors p[parameter][state], to o[value][state]. */
static void prepare_$name(long states, const double *restrict p, double *restrict o)
{
#pragma omp simd
    for (long s = 0; s < states; s++) {
$once
$out
    }
}
""")

ERRORS = Template("""
/* Residuals e[m][distance]; o[value][stride] as prepared. */
static void errors(long lanes, long ld, long stride, const double *restrict o, const double *restrict d,
                   long distance, double *restrict e)
{
$prepared
    lanes = padded(lanes);
#pragma omp simd
    for (long i = 0; i < lanes; i++) {
$lane
$out
    }
}
""")

KERNELS = Template("""
/* Upper triangle of A A' for $rows rows of PART numbers, added to S: two by four rows at a time. */
static void gram(const double *restrict a, double *restrict s)
{
    for (long i = 0; i < $rows; i += 2)
        for (long j = i & ~3L; j < $rows; j += 4) {
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
                    s[(i + m) * $rows + j + n] += total;
                }
        }
}

/* Slopes and, last, residual of each of $components components, times its weight w[m][distance]: a[m][$rows][PART]. */
static void fill(long lanes, long ld, const double *restrict o, const double *restrict d, long distance,
                 const double *restrict w, double *restrict a)
{
    const long stride = 1;
$prepared
    lanes = padded(lanes);
#pragma omp simd
    for (long i = 0; i < lanes; i++) {
$lane
$out
    }
}

/* Lanes to where they belong in memory; a large result goes past the caches, which it would only empty. */
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
    double o[$errors_values];
    prepare_errors(1, p, o);
    errors(n, ld, 1, o, d, ld, e);
}

/* Residuals e[m][lane] and slopes j[m * z][lane]. */
void slopes(long n, long ld, const double *restrict p, const double *restrict d, double *restrict e,
            double *restrict j, long large)
{
    double a[$components * $rows * PART] __attribute__((aligned(64))), o[$slopes_values], ones[PART];
    for (long i = 0; i < PART; i++) ones[i] = 1.0;
    prepare_slopes(1, p, o);
    for (long first = 0; first < n; first += PART) {
        const long lanes = n - first < PART ? n - first : PART;
        fill(lanes, ld, o, d + first, 0, ones, a);
        for (long m = 0; m < $components; m++) {
            const double *row = a + m * $rows * PART;
            double *to = j + m * $unknowns * ld + first;
            for (long k = 0; k < $unknowns; k++) put(lanes, row + k * PART, to + k * ld, large);
            put(lanes, row + $unknowns * PART, e + m * ld + first, 0);
        }
    }
}

/* Half the sum of squares of w e at each of `states` parameter vectors, added to cost[state]. */
void costs(long n, long ld, long states, const double *restrict p, const double *restrict d, const double *restrict w,
           double *restrict cost)
{
    double e[$components * PART] __attribute__((aligned(64))), o[$errors_values * STATES], turned[$parameters * STATES];
    for (long begun = 0; begun < states; begun += STATES) {
        const long count = states - begun < STATES ? states - begun : STATES;
        for (long s = 0; s < count; s++)
            for (long k = 0; k < $parameters; k++) turned[k * count + s] = p[(begun + s) * $parameters + k];
        prepare_errors(count, turned, o);
        for (long s = 0; s < count; s++) {
            double total = 0.0;
            for (long first = 0; first < n; first += PART) {
                const long lanes = padded(n - first < PART ? n - first : PART);
                errors(lanes, ld, count, o + s, d + first, PART, e);
                for (long m = 0; m < $components; m++) {
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

/* Weighted normal matrix of slopes and, last, residual, to s[$rows][$rows]. */
void normal(long n, long ld, const double *restrict p, const double *restrict d, const double *restrict w,
            double *restrict s)
{
    double a[$components * $rows * PART] __attribute__((aligned(64))), o[$slopes_values];
    prepare_slopes(1, p, o);
    for (long k = 0; k < $rows * $rows; k++) s[k] = 0.0;
    for (long k = 0; k < $components * $rows * PART; k++) a[k] = 0.0;
    for (long first = 0; first < n; first += PART) {
        const long lanes = n - first < PART ? n - first : PART;
        fill(lanes, ld, o, d + first, ld, w + first, a);
        if (first && lanes < PART)
            for (long r = 0; r < $components * $rows; r++)
                for (long k = lanes; k < PART; k++) a[r * PART + k] = 0.0;
        for (long m = 0; m < $components; m++) gram(a + m * $rows * PART, s);
    }
    for (long i = 1; i < $rows; i++)
        for (long k = 0; k < i; k++) s[i * $rows + k] = s[k * $rows + i];
}
""")
