#include "lanes.h"
#include "piece.h"

/* One pass of the extended Kalman filter over rows whose measured value is zero with unit noise, in coordinates
   (x - x0) / scale, with Joseph's form of the update, (I - K g') P (I - K g')' + K K'. Row r is a component of one lane
   of one piece: place[r] = {piece, lane, component}.

   mean[n], covariance[n][n]: belief, changed in place; means[r][n]: after each row; innovations[r], stds[r].
   work: z + constants + 8 (lanes + components (z + 1)) of the largest piece, and 4 n numbers. */
void extended_pass(long rows, long n, const piece *pieces, const long (*place)[3], const double *x0,
                   const double *scale, double *mean, double *covariance, double *means, double *innovations,
                   double *stds, double *work)
{
    double *g = work, *cross = g + n, *gain = cross + n, *after = gain + n;
    for (long r = 0; r < rows; r++) {
        const piece *here = pieces + place[r][0];
        const long lane = place[r][1], component = place[r][2], z = here->z;
        double *p = after + n, *d = p + z + here->constants, *e = d + 8 * here->lanes, *j = e + 8 * here->components;
        for (long i = 0; i < z; i++) p[i] = x0[here->column[i]] + scale[here->column[i]] * mean[here->column[i]];
        for (long i = 0; i < here->constants; i++) p[z + i] = here->constant[i];
        for (long k = 0; k < here->lanes; k++)
            for (long i = 0; i < 8; i++) d[8 * k + i] = here->d[k * here->ld + lane];
        here->slopes(1, 8, p, d, e, j, 0);
        const double w = here->w[component * here->ld + lane];
        for (long i = 0; i < n; i++) g[i] = 0.0;
        for (long i = 0; i < z; i++) g[here->column[i]] = w * scale[here->column[i]] * j[8 * (component * z + i)];
        innovations[r] = -w * e[8 * component];
        double variance = 1.0;
        for (long i = 0; i < n; i++) {
            double sum = 0.0;
#pragma omp simd reduction(+ : sum)
            for (long k = 0; k < n; k++) sum += covariance[i * n + k] * g[k];
            cross[i] = sum;
            variance += g[i] * sum;
        }
        stds[r] = sqrt(variance);
        for (long i = 0; i < n; i++) gain[i] = cross[i] / variance;
        for (long i = 0; i < n; i++) {
            double *row = covariance + i * n, sum = 0.0;
#pragma omp simd reduction(+ : sum)
            for (long k = 0; k < n; k++) {
                row[k] -= gain[i] * cross[k];
                sum += row[k] * g[k];
            }
            after[i] = gain[i] - sum;
        }
        for (long i = 0; i < n; i++)
            for (long k = 0; k <= i; k++) {
                const double one = covariance[i * n + k] + after[i] * gain[k];
                const double other = covariance[k * n + i] + after[k] * gain[i];
                covariance[i * n + k] = covariance[k * n + i] = 0.5 * (one + other);
            }
        for (long i = 0; i < n; i++) means[r * n + i] = mean[i] += gain[i] * innovations[r];
    }
}
