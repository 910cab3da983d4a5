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
