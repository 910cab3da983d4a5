"""What is the same in the C of every program: loops, reductions, the cubature filter's pass."""

from __future__ import annotations

from string import Template

HEAD = """
#include <math.h>
#if defined(__AVX512F__)
#define WIDE 8
#else
#define WIDE 4
#endif
#define PART 128
typedef double wide __attribute__((vector_size(8 * WIDE)));

/* Under names that the compiler does not know as sine and cosine, it does not merge them into one call that it cannot
   vectorise; the names in the library, and its forms for several lanes, are the usual ones. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
double lane_sin(double) __asm__("sin") __attribute__((simd("notinbranch")));
double lane_cos(double) __asm__("cos") __attribute__((simd("notinbranch")));
#else
#define lane_sin sin
#define lane_cos cos
#endif

/* Upper triangle of A A' for rows of PART numbers, added to S (rows x rows): two by four rows at a time. */
static void gram(long rows, const double *restrict a, double *restrict s)
{
    for (long i = 0; i < rows; i += 2)
        for (long j = i & ~3L; j < rows; j += 4) {
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
                    s[(i + m) * rows + j + n] += total;
                }
        }
}
"""

ONLY_RESIDUAL = Template("""
/* Residuals e[m][lane]. */
void residual(long n, long ld, const double *restrict p, const double *restrict d, double *restrict e)
{
$residual_once
#pragma omp simd
    for (long i = 0; i < n; i++) {
$residual_lane
$residual_out
    }
}
""")

KERNELS = Template("""
/* Residuals e[m][lane] and slopes j[m * z][lane]. */
void slopes(long n, long ld, const double *restrict p, const double *restrict d, double *restrict e,
            double *restrict j)
{
$slopes_once
#pragma omp simd
    for (long i = 0; i < n; i++) {
$slopes_lane
$slopes_out
    }
}

/* Half the sum of squares of w e at each of `states` parameter vectors, added to cost[state]. */
void costs(long n, long ld, long states, const double *restrict p, const double *restrict d, const double *restrict w,
           double *restrict cost)
{
    for (long s = 0; s < states; s++, p += $parameters) {
$residual_once
        double total = 0.0;
#pragma omp simd reduction(+ : total)
        for (long i = 0; i < n; i++) {
$residual_lane
$cost_sum
        }
        cost[s] += 0.5 * total;
    }
}

/* Weighted normal matrix of slopes and, last, residual, added to s[$rows][$rows]. */
void normal(long n, long ld, const double *restrict p, const double *restrict d, const double *restrict w,
            double *restrict s)
{
    double a[$rows * PART] __attribute__((aligned(64)));
$slopes_once
    for (long first = 0; first < n; first += PART) {
        const long lanes = n - first < PART ? n - first : PART;
$normal_parts
    }
    for (long i = 1; i < $rows; i++)
        for (long k = 0; k < i; k++) s[i * $rows + k] = s[k * $rows + i];
}
""")

PART_OF_NORMAL = Template("""
#pragma omp simd
        for (long k = 0; k < lanes; k++) {
            const long i = first + k;
$lane
            const double weight = w[$component * ld + i];
$out
        }
        for (long r = 0; r < $rows; r++)
            for (long k = lanes; k < PART; k++) a[r * PART + k] = 0.0;
        gram($rows, a, s);
""")


FILTER = Template("""
/* One pass of the square-root cubature filter over rows whose measured value is zero with unit noise, in coordinates
   (x - x0) / scale: eqs (15)-(24) of arXiv:2208.02652 as mended, S by an exact triangular downdate. Row r has the
   pattern pattern[r], which sees the unknowns at columns[pattern], and its own constants and data p[r].

   mean[n], root[n][n]: belief, changed in place; means[r][n]: after each row; innovations[r], stds[r].
   work: (2 n rounded up) * ($z + $m) + 4 n numbers. Returns the first row that leaves less than `least` of a variance,
   before which it stops, or the number of rows. */
long cubature_pass(long first, long rows, long n, const long *pattern, const long *columns, const double *x0,
                   const double *scale, const double *p, const double *weight, double least, double *mean, double *root,
                   double *means, double *innovations, double *stds, double *work)
{
    const long ld = (2 * n + 7) / 8 * 8;
    double *states = work, *e = states + $z * ld, *v = e + $m * ld, *up = v + n, *down = up + n, *gain = down + n;
    const double reach = sqrt((double)n);
    for (long r = first; r < rows; r++) {
        const long *column = columns + pattern[r / $m] * $z, component = r % $m;
        for (long j = 0; j < $z; j++) {
            const long k = column[j];
            const double base = x0[k] + scale[k] * mean[k];
            double *lane = states + j * ld;
            for (long i = 0; i < n; i++) {
                const double offset = reach * scale[k] * root[k * n + i];
                lane[i] = base + offset;
                lane[n + i] = base - offset;
            }
            for (long i = 2 * n; i < ld; i++) lane[i] = base;
        }
        residual(ld, ld, p + r / $m * $once, states, e);
        const double *z = e + component * ld, w = weight[r];
        double average = 0.0, variance = 1.0, left = 1.0;
        for (long i = 0; i < 2 * n; i++) average += z[i];
        average *= w / (2 * n);
        for (long i = 0; i < 2 * n; i++) variance += (w * z[i] - average) * (w * z[i] - average) / (2 * n);
        const double std = sqrt(variance);
        for (long i = 0; i < n; i++) {
            v[i] = w * (z[i] - z[n + i]) / (2 * reach * std);
            const double before = left;
            left -= v[i] * v[i];
            up[i] = sqrt(left / before);
            down[i] = v[i] / sqrt(left * before);
        }
        if (!(left > least)) return r;
        for (long k = 0; k < n; k++) {
            double beyond = 0.0, *row = root + k * n;
            for (long j = k; j >= 0; j--) {
                const double old = row[j];
                row[j] = old * up[j] - beyond * down[j];
                beyond += old * v[j];
            }
            gain[k] = beyond / std;
        }
        for (long k = 0; k < n; k++) means[r * n + k] = mean[k] -= gain[k] * average;
        innovations[r] = -average;
        stds[r] = std;
    }
    return rows;
}
""")
