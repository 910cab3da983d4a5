#include "lanes.h"
#include "piece.h"

#define LEAST_PIVOT 1e-12

/* Information[n][n], gradient[n] and cost of each of `count` pieces of the rows, at x, to sums[piece]. */
void accumulate(long count, const piece *pieces, long n, const double *x, double *sums, double *work)
{
    for (; count--; pieces++, sums += n * n + n + 1) {
        const long z = pieces->z, rows = pieces->rows;
        double *p = work, *s = work + z + pieces->constants, *gradient = sums + n * n;
        for (long i = 0; i < z; i++) p[i] = x[pieces->column[i]];
        for (long i = 0; i < pieces->constants; i++) p[z + i] = pieces->constant[i];
        pieces->normal(pieces->n, pieces->ld, p, pieces->d, pieces->w, s);
        for (long i = 0; i < n * n + n; i++) sums[i] = 0.0;
        for (long i = 0; i < z; i++) {
            double *row = sums + pieces->column[i] * n;
            for (long k = 0; k < z; k++) row[pieces->column[k]] = s[i * rows + k];
            gradient[pieces->column[i]] = s[i * rows + z];
        }
        gradient[n] = 0.5 * s[z * rows + z];
    }
}

/* A damped Gauss-Newton step y in coordinates (x - x0) / scale, (H + damping I) y = -g, with H and g of the whole
   objective, whose prior has an information prior[n][n]: x + scale y to out[n], then y'Hy and the fall of the cost that the model predicts. H + damping I = U'U by
   rows, which vectorises. work: 2 n (n + 1). Returns whether the matrix was safely positive definite: a pivot below
   LEAST_PIVOT of its diagonal element is mostly rounding. */
long damped_step(long n, const double *restrict information, const double *restrict gradient, const double *restrict x,
                 const double *restrict x0, const double *restrict scale, const double *restrict prior, double damping,
                 double *restrict out, double *restrict work)
{
    double *restrict h = work, *restrict u = h + n * n, *restrict g = u + n * n, *restrict y = g + n;
    double length = 0.0, predicted = 0.0;
    for (long i = 0; i < n; i++) {
        double pull = gradient[i];
        for (long k = 0; k < n; k++) {
            pull += prior[i * n + k] * (x[k] - x0[k]);
            h[i * n + k] = scale[i] * (information[i * n + k] + prior[i * n + k]) * scale[k];
        }
        g[i] = scale[i] * pull;
        y[i] = -g[i];
        for (long k = i; k < n; k++) u[i * n + k] = h[i * n + k];
        u[i * n + i] += damping;
    }
    for (long k = 0; k < n; k++) {
        const double *pivot = u + k * n;
        if (!(pivot[k] > LEAST_PIVOT * (h[k * n + k] + damping) && isfinite(pivot[k]))) return 0;
        const double inverse = 1.0 / sqrt(pivot[k]);
        for (long i = k; i < n; i++) u[k * n + i] *= inverse;
        y[k] /= pivot[k];
        for (long i = k + 1; i < n; i++) {
            const double part = pivot[i];
            double *row = u + i * n;
            for (long m = i; m < n; m++) row[m] -= part * pivot[m];
            y[i] -= part * y[k];
        }
    }
    for (long k = n - 1; k >= 0; k--) {
        double sum = y[k];
        for (long i = k + 1; i < n; i++) sum -= u[k * n + i] * y[i];
        y[k] = sum / u[k * n + k];
    }
    for (long i = 0; i < n; i++) {
        double sum = 0.0;
#pragma omp simd reduction(+ : sum)
        for (long k = 0; k < n; k++) sum += h[i * n + k] * y[k];
        length += y[i] * sum;
        predicted += 0.5 * y[i] * (damping * y[i] - g[i]);
        out[i] = x[i] + scale[i] * y[i];
    }
    out[n] = length;
    out[n + 1] = predicted;
    return 1;
}
