/* What Python writes for each problem, in place of this example: the residual e = p[0] sin(q) - p[1] p[1], with its
   slopes by p[0] and p[1]. Editors and compilers understand the other files by it.

   A lane reads what depends on parameters alone from o, where each call prepares it, and what depends on data alone,
   here d[0] = sin(q), from d, where it was put once for all calls. */
#define PARAMETERS 2 /* numbers in p */
#define COMPONENTS 1 /* residuals a row */
#define UNKNOWNS 2   /* slopes a residual */
#define ROWS 4       /* of the normal matrix: the slopes, the residual, and zeros up to a multiple of four */

#define ERRORS_PREPARED 2 /* values of parameters alone that residuals read */
#define PREPARE_ERRORS                   \
    const double v0 = p[0 * states + s]; \
    const double v4 = p[1 * states + s]; \
    const double v5 = v4 * v4;           \
    o[0 * states + s] = v0;              \
    o[1 * states + s] = v5;
#define READ_ERRORS                  \
    const double v0 = o[0 * stride]; \
    const double v5 = o[1 * stride];
#define LANE_OF_ERRORS               \
    const double d2 = d[0 * ld + i]; \
    const double v3 = v0 * d2;       \
    const double v6 = v3 - v5;       \
    e[0 * distance + i] = v6;

#define SLOPES_PREPARED 3 /* values of parameters alone that residuals and slopes read */
#define PREPARE_SLOPES                   \
    const double v0 = p[0 * states + s]; \
    const double v4 = p[1 * states + s]; \
    const double v5 = v4 * v4;           \
    const double v7 = 2.0 * v4;          \
    const double v8 = -v7;               \
    o[0 * states + s] = v0;              \
    o[1 * states + s] = v5;              \
    o[2 * states + s] = v8;
#define READ_SLOPES                  \
    const double v0 = o[0 * stride]; \
    const double v5 = o[1 * stride]; \
    const double v8 = o[2 * stride];
#define LANE_OF_SLOPES                     \
    const double d2 = d[0 * ld + i];       \
    const double v3 = v0 * d2;             \
    const double v6 = v3 - v5;             \
    const double w0 = w[0 * distance + i]; \
    a[0 * PART + i] = w0 * d2;             \
    a[1 * PART + i] = w0 * v8;             \
    a[2 * PART + i] = w0 * v6;
