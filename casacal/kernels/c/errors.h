#include "lanes.h"
#include "program.h"

/* What depends on parameters alone, of each of `states` vectors p[parameter][state], to o[value][state]. */
static void prepare_errors(long states, const double *restrict p, double *restrict o)
{
#pragma omp simd
    for (long s = 0; s < states; s++) {
        PREPARE_ERRORS
    }
}

/* Residuals e[m][distance]; o[value][stride] as prepared. */
static void errors(long lanes, long ld, long stride, const double *restrict o, const double *restrict d,
                   long distance, double *restrict e)
{
    READ_ERRORS
    lanes = padded(lanes);
#pragma omp simd
    for (long i = 0; i < lanes; i++) {
        LANE_OF_ERRORS
    }
}
