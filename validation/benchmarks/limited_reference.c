/* The limited-error benchmark's other side: the moment form in C, eight points at a time, sums in registers.
   Input per network: n unit directions, n rows of visibility bits (one per tag of four points); output: sum of traces. */
#include <stdint.h>
#include <string.h>

typedef double v4 __attribute__((vector_size(32)));

static v4 load(const double *from) { v4 value; memcpy(&value, from, 32); return value; }

void sum_of_traces(long networks, long n, long m, long words, double radius, const double *points, const double *u,
                   const uint64_t *bits, double *out)
{
    const double *px = points, *py = points + m, *pz = points + 2 * m;
    for (long p = 0; p < networks; p++) {
        const double *du = u + 3 * n * p;
        const uint64_t *rows = bits + words * n * p;
        v4 total = {0, 0, 0, 0};
        for (long j = 0; j + 4 <= m; j += 4) {
            long tag = j / 4;
            v4 x = load(px + j), y = load(py + j), z = load(pz + j);
            v4 sxx = {0}, sxy = {0}, sxz = {0}, syy = {0}, syz = {0}, szz = {0}, sx = {0}, sy = {0}, sz = {0};
            for (long i = 0; i < n; i++) {
                double seen = (double)((rows[i * words + (tag >> 6)] >> (tag & 63)) & 1);
                double a = du[3 * i], b = du[3 * i + 1], c = du[3 * i + 2];
                v4 depth = radius - (a * x + b * y + c * z);
                v4 square = depth * depth;
                v4 s = seen / (square * square);
                v4 s_a = s * a, s_b = s * b, s_c = s * c;
                sxx += s_a * a; sxy += s_a * b; sxz += s_a * c; syy += s_b * b; syz += s_b * c; szz += s_c * c;
                sx += s_a; sy += s_b; sz += s_c;
            }
            v4 t = sxx + syy + szz, rr = (v4){1, 1, 1, 1} * (radius * radius);
            v4 spread = t * (x * x + y * y + z * z + rr) - 2 * radius * (x * sx + y * sy + z * sz);
            v4 a0 = y * sxz - z * sxy, a1 = y * syz - z * syy, a2 = y * szz - z * syz;
            v4 b0 = z * sxx - x * sxz, b1 = z * sxy - x * syz, b2 = z * sxz - x * szz;
            v4 c0 = x * sxy - y * sxx, c1 = x * syy - y * sxy;
            v4 nxx = spread - (t * x * x - 2 * radius * x * sx + rr * sxx) - (y * a2 - z * a1);
            v4 nyy = spread - (t * y * y - 2 * radius * y * sy + rr * syy) - (z * b0 - x * b2);
            v4 nzz = spread - (t * z * z - 2 * radius * z * sz + rr * szz) - (x * c1 - y * c0);
            v4 nxy = radius * (x * sy + y * sx) - t * x * y - rr * sxy - (z * a0 - x * a2);
            v4 nxz = radius * (x * sz + z * sx) - t * x * z - rr * sxz - (x * a1 - y * a0);
            v4 nyz = radius * (y * sz + z * sy) - t * y * z - rr * syz - (x * b1 - y * b0);
            v4 cxx = nyy * nzz - nyz * nyz, cyy = nxx * nzz - nxz * nxz, czz = nxx * nyy - nxy * nxy;
            v4 det = nxx * cxx + nxy * (nxz * nyz - nxy * nzz) + nxz * (nxy * nyz - nxz * nyy);
            total += (cxx + cyy + czz) / det;
        }
        out[p] = total[0] + total[1] + total[2] + total[3];
    }
}
