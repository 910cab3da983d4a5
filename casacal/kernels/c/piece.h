/* Some rows that see the same unknowns: their kernels, their data, and where they stand in x. */
typedef struct {
    void (*normal)(long, long, const double *, const double *, const double *, double *);
    void (*slopes)(long, long, const double *, const double *, double *, double *, long);
    long n, ld, z, rows, constants, components, lanes;
    const long *column;     /* where the z slopes stand in x */
    const double *constant; /* what follows them in p */
    const double *d, *w;    /* [lanes][ld], [components][ld] */
} piece;
