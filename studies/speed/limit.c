/* The limit: what a programmer writes by hand for one case, a six-axis standard DH arm whose tip touches one plane.
 *
 * Unknowns, 27: alpha[6], a[6], d[6], theta[6], two tilts of the plane's normal, its offset. Data of sample i, column by
 * column: sin q_1 ... sin q_6, cos q_1 ... cos q_6. The point is carried from the tip to the base link by link, and the
 * gradient of n . p back again. p: alpha, a, d, theta, normal[3], tangent[3], tangent[3], offset.
 */
#include <math.h>

/* as in casacal's kernels: sine and cosine of several lanes at once, where the library has them */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
double lane_sin(double) __asm__("sin") __attribute__((const, simd("notinbranch")));
double lane_cos(double) __asm__("cos") __attribute__((const, simd("notinbranch")));
#else
#define lane_sin sin
#define lane_cos cos
#endif

#define AXES 6
#define UNKNOWNS 27
#define ROWS 28
#define PART 128
#if defined(__AVX512F__)
#define WIDE 8
#else
#define WIDE 4
#endif
typedef double wide __attribute__((vector_size(8 * WIDE)));
typedef double loose __attribute__((vector_size(8 * WIDE), aligned(8))); /* the same, anywhere in memory */
#define AT(place) (*(const loose *)(place))

typedef struct {
    double sa[AXES], ca[AXES], st[AXES], ct[AXES];
} trigonometry;

static trigonometry prepare(const double *p)
{
    trigonometry t;
    for (int k = 0; k < AXES; k++) {
        t.sa[k] = sin(p[k]);
        t.ca[k] = cos(p[k]);
        t.st[k] = sin(p[18 + k]);
        t.ct[k] = cos(p[18 + k]);
    }
    return t;
}

#define FORWARD                                                                                                        \
    wide X[AXES], Y[AXES], V[AXES], W[AXES], S[AXES], C[AXES], x = {0}, y = {0}, z = {0};                              \
    _Pragma("GCC unroll 6") for (int k = AXES - 1; k >= 0; k--)                                                        \
    {                                                                                                                  \
        const wide sq = AT(q + k * ld + i), cq = AT(q + (AXES + k) * ld + i), u = x + a[k];                            \
        S[k] = t.st[k] * cq + t.ct[k] * sq;                                                                            \
        C[k] = t.ct[k] * cq - t.st[k] * sq;                                                                            \
        V[k] = t.ca[k] * y - t.sa[k] * z;                                                                              \
        W[k] = t.sa[k] * y + t.ca[k] * z;                                                                              \
        X[k] = x = C[k] * u - S[k] * V[k];                                                                             \
        Y[k] = y = S[k] * u + C[k] * V[k];                                                                             \
        z = W[k] + d[k];                                                                                               \
    }                                                                                                                  \
    const wide e = n[0] * x + n[1] * y + n[2] * z - offset;

#define BACKWARD(STORE)                                                                                                \
    wide gx = (wide){0} + n[0], gy = (wide){0} + n[1], gz = (wide){0} + n[2];                                          \
    _Pragma("GCC unroll 6") for (int k = 0; k < AXES; k++)                                                             \
    {                                                                                                                  \
        const wide gu = C[k] * gx + S[k] * gy, gv = C[k] * gy - S[k] * gx;                                             \
        STORE(18 + k, gy * X[k] - gx * Y[k]);                                                                          \
        STORE(6 + k, gu);                                                                                              \
        STORE(12 + k, gz);                                                                                             \
        STORE(k, gz * V[k] - gv * W[k]);                                                                                \
        gy = t.ca[k] * gv + t.sa[k] * gz;                                                                              \
        gz = t.ca[k] * gz - t.sa[k] * gv;                                                                              \
        gx = gu;                                                                                                       \
    }                                                                                                                  \
    STORE(24, t1[0] * x + t1[1] * y + t1[2] * z);                                                                      \
    STORE(25, t2[0] * x + t2[1] * y + t2[2] * z);                                                                      \
    STORE(26, (wide){0} - 1.0);

#define NAMES                                                                                                          \
    const trigonometry t = prepare(p);                                                                                 \
    const double *a = p + 6, *d = p + 12, *n = p + 24, *t1 = p + 27, *t2 = p + 30, offset = p[33];                     \
    (void)t1, (void)t2;

void limit_slopes(long count, long ld, const double *restrict p, const double *restrict q, double *restrict e_out,
                  double *restrict j)
{
    NAMES
    for (long i = 0; i < count; i += WIDE) { /* ld is a multiple of WIDE: padded lanes are computed and ignored */
        FORWARD
        *(loose *)(e_out + i) = e;
#define TO_MEMORY(row, value) *(loose *)(j + (row)*ld + i) = (value)
        BACKWARD(TO_MEMORY)
    }
}

#if defined(__AVX__) && defined(__GNUC__) && !defined(__clang__)
typedef double four __attribute__((vector_size(32)));
#define PAST(to, from) __builtin_ia32_movntpd256(to, *(const four *)(from))
#define STEP 4
#elif defined(__clang__)
#define PAST(to, from) __builtin_nontemporal_store(*(const wide *)(from), (wide *)(to))
#define STEP WIDE
#else
#define PAST(to, from) (*(to) = *(from))
#define STEP 1
#endif

/* The same, the Jacobian written past the caches, which a large one would only empty: part by part, so that each row is
 * written in long runs. j and ld at multiples of 64 bytes. */
void limit_slopes_past(long count, long ld, const double *restrict p, const double *restrict q, double *restrict e_out,
                       double *restrict j)
{
    double part[UNKNOWNS * PART] __attribute__((aligned(64)));
    NAMES
    for (long first = 0; first < count; first += PART) {
        const long lanes = count - first < PART ? (count - first + WIDE - 1) / WIDE * WIDE : PART;
        for (long at = 0; at < lanes; at += WIDE) {
            const long i = first + at;
            FORWARD
            *(loose *)(e_out + i) = e;
#define TO_ROW(row, value) *(wide *)(part + (row)*PART + at) = (value)
            BACKWARD(TO_ROW)
        }
        for (long row = 0; row < UNKNOWNS; row++)
            for (long k = 0; k < lanes; k += STEP) PAST(j + row * ld + first + k, part + row * PART + k);
    }
}

void limit_costs(long count, long ld, long states, const double *restrict p, const double *restrict q,
                 const double *restrict w, double *restrict cost)
{
    for (long s = 0; s < states; s++, p += 34) {
        NAMES
        wide total = {0};
        for (long i = 0; i < count; i += WIDE) {
            FORWARD
            const wide r = AT(w + i) * e;
            total += r * r;
        }
        cost[s] = 0.0;
        for (int k = 0; k < WIDE; k++) cost[s] += 0.5 * total[k];
    }
}

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
                for (int n = 0; n < 4; n++)
                    for (int k = 0; k < WIDE; k++) s[(i + m) * ROWS + j + n] += sum[m][n][k];
        }
}

void limit_normal(long count, long ld, const double *restrict p, const double *restrict q, const double *restrict w,
                  double *restrict s)
{
    double part[ROWS * PART] __attribute__((aligned(64)));
    NAMES
    for (long k = 0; k < ROWS * ROWS; k++) s[k] = 0.0;
    for (long first = 0; first < count; first += PART) {
        const long lanes = count - first < PART ? count - first : PART;
        const long filled = (lanes + WIDE - 1) / WIDE * WIDE;
        for (long at = 0; at < filled; at += WIDE) { /* padded lanes weigh nothing */
            const long i = first + at;
            const wide weight = AT(w + i);
            FORWARD
#define TO_PART(row, value) *(wide *)(part + (row)*PART + at) = weight * (value)
            BACKWARD(TO_PART)
            *(wide *)(part + 27 * PART + at) = weight * e;
        }
        for (long r = 0; r < ROWS; r++)
            for (long k = filled; k < PART; k++) part[r * PART + k] = 0.0;
        gram(part, s);
    }
}

static int solve(double *h, double *g)
{
    for (int k = 0; k < UNKNOWNS; k++) {
        for (int i = k; i < UNKNOWNS; i++) {
            double sum = h[i * UNKNOWNS + k];
            for (int m = 0; m < k; m++) sum -= h[i * UNKNOWNS + m] * h[k * UNKNOWNS + m];
            if (i == k) {
                if (!(sum > 0.0)) return 0;
                h[k * UNKNOWNS + k] = sqrt(sum);
            } else
                h[i * UNKNOWNS + k] = sum / h[k * UNKNOWNS + k];
        }
    }
    for (int i = 0; i < UNKNOWNS; i++) {
        for (int m = 0; m < i; m++) g[i] -= h[i * UNKNOWNS + m] * g[m];
        g[i] /= h[i * UNKNOWNS + i];
    }
    for (int i = UNKNOWNS - 1; i >= 0; i--) {
        for (int m = i + 1; m < UNKNOWNS; m++) g[i] -= h[m * UNKNOWNS + i] * g[m];
        g[i] /= h[i * UNKNOWNS + i];
    }
    return 1;
}

/* Levenberg-Marquardt in the prior's metric, `evaluations` of the normal equations; the plane turns with its tangents
 * to first order, which costs as much as turning it exactly. x: 27, prior and start: standard deviations. */
void limit_lm(long count, long ld, const double *restrict start, const double *restrict q, const double *restrict w,
              const double *restrict scale, const double *restrict prior, long evaluations, double *restrict x)
{
    double s[ROWS * ROWS], h[UNKNOWNS * UNKNOWNS], g[UNKNOWNS], p[34], mu = 1e-3;
    for (int k = 0; k < UNKNOWNS; k++) x[k] = 0.0;
    for (long step = 0; step < evaluations; step++) {
        for (int k = 0; k < 34; k++) p[k] = start[k];
        for (int k = 0; k < 24; k++) p[k] += x[k];
        for (int k = 0; k < 3; k++) p[24 + k] += x[24] * start[27 + k] + x[25] * start[30 + k];
        p[33] += x[26];
        limit_normal(count, ld, p, q, w, s);
        for (int i = 0; i < UNKNOWNS; i++) {
            g[i] = -scale[i] * (s[i * ROWS + 27] + prior[i] * x[i]);
            for (int k = 0; k <= i; k++) h[i * UNKNOWNS + k] = scale[i] * s[k * ROWS + i] * scale[k];
            h[i * UNKNOWNS + i] += scale[i] * scale[i] * prior[i] + mu;
        }
        if (!solve(h, g)) return;
        for (int k = 0; k < UNKNOWNS; k++) x[k] += scale[k] * g[k];
        mu /= 3.0;
    }
}

/* One pass of the square-root cubature filter over rows that measure zero with unit noise once divided by `noise`, in
 * coordinates of `scale` about `start`: the points are lanes, the root shrinks by an exact triangular downdate. After the
 * 34 numbers of p, start holds the point about which the plane turns. q: joint values, axis by axis [AXES][count]; x:
 * estimate, 27; work: 28 * POINTS + 27 * 27 numbers. */
#define POINTS 56
void limit_filter(long count, const double *restrict start, const double *restrict q, const double *restrict scale,
                  double noise, double *restrict x, double *restrict work)
{
    double *state = work, *e = state + UNKNOWNS * POINTS, *root = e + POINTS, mean[UNKNOWNS] = {0};
    const double reach = sqrt((double)UNKNOWNS), *n = start + 24, *t1 = start + 27, *t2 = start + 30, *base = start + 34;
    for (int i = 0; i < UNKNOWNS * UNKNOWNS; i++) root[i] = i % (UNKNOWNS + 1) ? 0.0 : 1.0;
    for (long r = 0; r < count; r++) {
        for (int k = 0; k < UNKNOWNS; k++) {
            const double center = (k < 24 ? start[k] : 0.0) + scale[k] * mean[k];
            double *lane = state + k * POINTS;
            for (int i = 0; i < UNKNOWNS; i++) {
                const double offset = reach * scale[k] * root[k * UNKNOWNS + i];
                lane[i] = center + offset;
                lane[UNKNOWNS + i] = center - offset;
            }
            lane[54] = lane[55] = center;
        }
#pragma omp simd
        for (int i = 0; i < POINTS; i++) {
            double px = 0.0, py = 0.0, pz = 0.0;
#pragma GCC unroll 6
            for (int k = AXES - 1; k >= 0; k--) {
                const double alpha = state[k * POINTS + i], angle = state[(18 + k) * POINTS + i] + q[k * count + r];
                const double sa = lane_sin(alpha), ca = lane_cos(alpha), st = lane_sin(angle), ct = lane_cos(angle);
                const double u = px + state[(6 + k) * POINTS + i], v = ca * py - sa * pz;
                pz = sa * py + ca * pz + state[(12 + k) * POINTS + i];
                px = ct * u - st * v;
                py = st * u + ct * v;
            }
            const double a = state[24 * POINTS + i], b = state[25 * POINTS + i], d = 1.0 / (1.0 + 0.25 * (a * a + b * b));
            const double c = (1.0 - 0.25 * (a * a + b * b)) * d, f = a * d, g = b * d;
            e[i] = ((c * n[0] + f * t1[0] + g * t2[0]) * (px - base[0]) + (c * n[1] + f * t1[1] + g * t2[1]) * (py - base[1]) +
                    (c * n[2] + f * t1[2] + g * t2[2]) * (pz - base[2]) - state[26 * POINTS + i]) / noise;
        }
        double average = 0.0, variance = 1.0, left = 1.0, v[UNKNOWNS], up[UNKNOWNS], down[UNKNOWNS];
        for (int i = 0; i < 54; i++) average += e[i] / 54;
        for (int i = 0; i < 54; i++) variance += (e[i] - average) * (e[i] - average) / 54;
        const double std = sqrt(variance);
        for (int i = 0; i < UNKNOWNS; i++) {
            v[i] = (e[i] - e[UNKNOWNS + i]) / (2 * reach * std);
            const double before = left;
            left -= v[i] * v[i];
            up[i] = sqrt(left / before);
            down[i] = v[i] / sqrt(left * before);
        }
        for (int k = 0; k < UNKNOWNS; k++) {
            double beyond = 0.0, *row = root + k * UNKNOWNS;
            for (int j = k; j >= 0; j--) {
                const double old = row[j];
                row[j] = old * up[j] - beyond * down[j];
                beyond += old * v[j];
            }
            mean[k] -= beyond / std * average;
        }
    }
    for (int k = 0; k < UNKNOWNS; k++) x[k] = scale[k] * mean[k];
}
