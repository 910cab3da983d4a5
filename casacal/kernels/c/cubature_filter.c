#include "errors.h"

/* One pass of the square-root cubature filter over rows whose measured value is zero with unit noise, in coordinates
   (x - x0) / scale: eqs (15)-(24) of arXiv:2208.02652 as corrected, S by an exact triangular downdate. Row r has the
   pattern pattern[r], which sees the unknowns at columns[pattern], and its own constants and data p[r].

   mean[n], root[n][n]: belief, changed in place; means[r][n]: after each row; innovations[r], stds[r].
   work: (2 n rounded up) * (UNKNOWNS + COMPONENTS) + 4 n numbers. Returns the first row that leaves less than `least`
   of a variance, before which it stops, or the number of rows. */
long cubature_pass(long first, long rows, long n, const long *pattern, const long *columns, const double *x0,
                   const double *scale, const double *p, const double *weight, double least, double *mean, double *root,
                   double *means, double *innovations, double *stds, double *work)
{
    const long ld = padded(2 * n);
    double *states = work, *e = states + UNKNOWNS * ld, *v = e + COMPONENTS * ld;
    double *up = v + n, *down = up + n, *gain = down + n;
    double o[ERRORS_PREPARED];
    const double reach = sqrt((double)n);
    for (long r = first; r < rows; r++) {
        const long *column = columns + pattern[r / COMPONENTS] * UNKNOWNS, component = r % COMPONENTS;
        for (long j = 0; j < UNKNOWNS; j++) {
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
        prepare_errors(1, p + r / COMPONENTS * PARAMETERS, o);
        errors(ld, ld, 1, o, states, ld, e);
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
