// Expected crossings along rays through a grid of fibre moments, in float32. Sixteen samples of one ray at a time: each
// is interpolated from four loads of two voxels (neighbours in z, eight numbers each); then the sixteen are turned so
// that each of the six components fills a vector. Follows dsfit/render/grid/march.py.
#include <cmath>
#include <cstdint>
#include <cstring>

#define W 16
typedef float V __attribute__((vector_size(64)));
typedef int32_t I __attribute__((vector_size(64)));
#define INLINE static inline __attribute__((always_inline))

struct Field {
    const float* moments;  // [X + 2][Y + 2][Z + 2][8]: xx yy zz xy xz yz 0 0, with a border of zeros
    int64_t size[3];       // X + 2, Y + 2, Z + 2
    float low[3];          // of the box, in world coordinates
    float inverse;         // 1 / voxel
    float voxel, step, max_n, spread;
};

INLINE V load(const float* p) { V r; std::memcpy(&r, p, 64); return r; }
INLINE V vmin(V a, V b) { return a < b ? a : b; }
INLINE V vmax(V a, V b) { return a > b ? a : b; }
INLINE V root(V x) { V r; for (int l = 0; l < W; l++) r[l] = __builtin_sqrtf(x[l]); return r; }
INLINE float total(V x) {
    float part[W];
    std::memcpy(part, &x, 64);
    for (int half = W / 2; half > 0; half /= 2)
        for (int l = 0; l < half; l++) part[l] += part[l + half];
    return part[0];
}

#if defined(__clang__)
#define PICK(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define PICK(a, b, ...) __builtin_shuffle(a, b, I{__VA_ARGS__})
#endif

// Eight vectors of eight components of two samples each, turned into a vector of sixteen samples for each component.
INLINE void turn(V* rows) {
#define SWAP(i, j, even, odd) { V a = rows[i], b = rows[j]; rows[i] = PICK(a, b, even); rows[j] = PICK(a, b, odd); }
#define ONES(i, j) SWAP(i, j, EVEN1, ODD1)
#define TWOS(i, j) SWAP(i, j, EVEN2, ODD2)
#define FOURS(i, j) SWAP(i, j, EVEN4, ODD4)
#define EVEN1 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30
#define ODD1 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31
#define EVEN2 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29
#define ODD2 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31
#define EVEN4 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27
#define ODD4 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31
    ONES(0, 1) ONES(2, 3) ONES(4, 5) ONES(6, 7)
    TWOS(0, 2) TWOS(1, 3) TWOS(4, 6) TWOS(5, 7)
    FOURS(0, 4) FOURS(1, 5) FOURS(2, 6) FOURS(3, 7)
}

struct Ray { float start[3], d[3], enter, leave; };

// Coordinates in voxels, centres at 1 to the number of them; the box [0, size - 1] is where the field is not zero. The
// ray is marched from `begin` voxels on.
INLINE Ray ray_of(const Field& f, const float* origin, const float* direction, float begin) {
    Ray r;
    float square = 0;
    for (int a = 0; a < 3; a++) square += direction[a] * direction[a];
    float scale = 1.0f / __builtin_sqrtf(square);
    float enter = begin, leave = INFINITY;
    for (int a = 0; a < 3; a++) {
        r.start[a] = (origin[a] - f.low[a]) * f.inverse + 0.5f;
        r.d[a] = direction[a] * scale;
        float top = (float)(f.size[a] - 1);
        if (r.d[a] == 0) {
            if (r.start[a] < 0 || r.start[a] > top) leave = -INFINITY;
            continue;
        }
        float inverse = 1.0f / r.d[a], one = -r.start[a] * inverse, two = (top - r.start[a]) * inverse;
        float near = one < two ? one : two, far = one < two ? two : one;
        enter = near > enter ? near : enter;
        leave = far < leave ? far : leave;
    }
    r.enter = enter;
    r.leave = leave;
    return r;
}

// Eight samples: interpolated in x and y, with both neighbours in z.
INLINE void interpolate(const Field& f, V* sample, int from, const int32_t* at, const float (*w)[W], int32_t slab,
                        int32_t row) {
    for (int s = from; s < from + 8; s++) {
        const float* p = f.moments + at[s];
        sample[s] = w[0][s] * load(p) + w[1][s] * load(p + row) + w[2][s] * load(p + slab) + w[3][s] * load(p + slab + row);
    }
}

INLINE float march(const Field& f, const Ray& r) {
    if (!(r.leave > r.enter)) return 0;
    const float x = r.d[0], y = r.d[1], z = r.d[2];
    const int32_t row = (int32_t)f.size[2] * 8, slab = (int32_t)f.size[1] * row;
    const V lanes = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    const int64_t steps = (int64_t)std::ceil((r.leave - r.enter) / f.step);
    float n = 0;
    for (int64_t first = 0; first < steps; first += W) {
        V t = r.enter + (lanes + ((float)first + 0.5f)) * f.step;
        V part[3];
        I cell[3];
        for (int a = 0; a < 3; a++) {
            V top = V{} + (float)(f.size[a] - 1);
            V place = vmin(vmax(r.start[a] + t * r.d[a], V{}), top);
            cell[a] = __builtin_convertvector(vmin(place, top - 1.0f), I);
            part[a] = place - __builtin_convertvector(cell[a], V);
        }
        alignas(64) int32_t at[W];
        alignas(64) float weights[4][W];  // of the neighbours in x and y
        I index = cell[0] * slab + cell[1] * row + cell[2] * 8;
        V both = part[0] * part[1];
        V shares[4] = {1.0f - part[0] - part[1] + both, part[1] - both, part[0] - both, both};
        std::memcpy(at, &index, sizeof at);
        std::memcpy(weights, shares, sizeof weights);
        V sample[W];
        const int64_t left = steps - first;
        interpolate(f, sample, 0, at, weights, slab, row);
        if (left > 8) interpolate(f, sample, 8, at, weights, slab, row);
        else for (int s = 8; s < W; s++) sample[s] = V{};
        V rows[8];
        for (int s = 0; s < 8; s++) {
            V low = PICK(sample[s], sample[s + 8], 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
            sample[s] = PICK(sample[s], sample[s + 8], 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
            rows[s] = low;
        }
        turn(rows);
        turn(sample);
        V m[6];
        for (int c = 0; c < 6; c++) m[c] = rows[c] + part[2] * (sample[c] - rows[c]);
        V tx = m[0] * x + m[3] * y + m[4] * z, ty = m[3] * x + m[1] * y + m[5] * z, tz = m[4] * x + m[5] * y + m[2] * z;
        V trace = m[0] + m[1] + m[2];
        V along = tx * x + ty * y + tz * z;
        V power = trace * (trace - along);
        V spread = vmax(trace * along - (tx * tx + ty * ty + tz * tz), V{});
        I some = (power > trace * trace * 1.1920929e-7f) & (trace > 3.3e-10f);
        V base = root(some ? power : V{} + 1.0f);
        V rate = base - f.spread * spread / base;
        n += total(some ? rate : V{});
        if (n * (f.step * f.voxel) >= f.max_n) return f.max_n;
    }
    return n * (f.step * f.voxel);
}

extern "C" void dsfit_march(const Field* field, const float* origin, const float* direction, float begin, int64_t count,
                            float* n) {
    const Field f = *field;
    for (int64_t i = 0; i < count; i++) n[i] = march(f, ray_of(f, origin + 3 * i, direction + 3 * i, begin));
}

// Rays from the points of hits in directions (theta, phi) of their frames [H][3][3], rows tangent, normal, binormal.
extern "C" void dsfit_march_hits(const Field* field, const float* positions, const float* frames, const int64_t* hit,
                                 const float* theta, const float* phi, float begin, int64_t count, float* n) {
    const Field f = *field;
    for (int64_t i = 0; i < count; i++) {
        const float* frame = frames + 9 * hit[i];
        float c = std::cos(theta[i]), u = std::sin(theta[i]), v = c * std::cos(phi[i]), w = c * std::sin(phi[i]);
        float d[3];
        for (int a = 0; a < 3; a++) d[a] = u * frame[a] + v * frame[3 + a] + w * frame[6 + a];
        n[i] = march(f, ray_of(f, positions + 3 * hit[i], d, begin));
    }
}
