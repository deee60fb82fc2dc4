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

// The components of eight pairs of samples: rows[s] holds sample s in its lower half and s + 8 in its upper one.
INLINE void turn(V* rows) {
    const I even = {0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30};
    const I odd = {1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31};
    const I even2 = {0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29};
    const I odd2 = {2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31};
    const I even4 = {0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27};
    const I odd4 = {4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31};
#define SWAP(i, j, e, o) { V a = rows[i], b = rows[j]; rows[i] = __builtin_shuffle(a, b, e); rows[j] = __builtin_shuffle(a, b, o); }
    SWAP(0, 1, even, odd) SWAP(2, 3, even, odd) SWAP(4, 5, even, odd) SWAP(6, 7, even, odd)
    SWAP(0, 2, even2, odd2) SWAP(1, 3, even2, odd2) SWAP(4, 6, even2, odd2) SWAP(5, 7, even2, odd2)
    SWAP(0, 4, even4, odd4) SWAP(1, 5, even4, odd4) SWAP(2, 6, even4, odd4) SWAP(3, 7, even4, odd4)
#undef SWAP
}

struct Ray { float start[3], d[3], enter, leave; };

// Coordinates in voxels, centres at 1 to the number of them; the box [0, size - 1] is where the field is not zero.
INLINE Ray ray_of(const Field& f, const float* origin, const float* direction) {
    Ray r;
    float square = 0;
    for (int a = 0; a < 3; a++) square += direction[a] * direction[a];
    float scale = 1.0f / __builtin_sqrtf(square);
    float enter = 0, leave = INFINITY;
    for (int a = 0; a < 3; a++) {
        r.start[a] = (origin[a] - f.low[a]) * f.inverse + 0.5f;
        r.d[a] = direction[a] * scale;
        float top = (float)(f.size[a] - 1);
        if (r.d[a] == 0) {
            if (r.start[a] < 0 || r.start[a] > top) leave = -1;
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
        alignas(64) float w00[W], w01[W], w10[W], w11[W], up[W];
        I index = cell[0] * slab + cell[1] * row + cell[2] * 8;
        V w = part[0] * part[1];
        std::memcpy(at, &index, 64);
        V v11 = w, v10 = part[0] - w, v01 = part[1] - w, v00 = 1.0f - part[0] - part[1] + w;
        std::memcpy(w11, &v11, 64); std::memcpy(w10, &v10, 64); std::memcpy(w01, &v01, 64); std::memcpy(w00, &v00, 64);
        std::memcpy(up, &part[2], 64);
        V sample[W];
#define SAMPLE(from, to) for (int s = from; s < to; s++) { const float* p = f.moments + at[s]; sample[s] = w00[s] * load(p) + w01[s] * load(p + row) + w10[s] * load(p + slab) + w11[s] * load(p + slab + row); }
        SAMPLE(0, 8)
        if (steps - first > 8) SAMPLE(8, 16) else for (int s = 8; s < W; s++) sample[s] = V{};
        V rows[8];
        const I lower = {0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23};
        const I upper = {8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31};
        for (int s = 0; s < 8; s++) {
            rows[s] = __builtin_shuffle(sample[s], sample[s + 8], lower);
            sample[s] = __builtin_shuffle(sample[s], sample[s + 8], upper);
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

extern "C" void dsfit_march(const Field* field, const float* origin, const float* direction, int64_t count, float* n) {
    const Field f = *field;
    for (int64_t i = 0; i < count; i++) n[i] = march(f, ray_of(f, origin + 3 * i, direction + 3 * i));
}

// Rays from the points of hits in directions (theta, phi) of their frames [H][3][3], rows tangent, normal, binormal.
extern "C" void dsfit_march_hits(const Field* field, const float* positions, const float* frames, const int64_t* hit,
                                 const float* theta, const float* phi, int64_t count, float* n) {
    const Field f = *field;
    for (int64_t i = 0; i < count; i++) {
        const float* frame = frames + 9 * hit[i];
        float c = std::cos(theta[i]), u = std::sin(theta[i]), v = c * std::cos(phi[i]), w = c * std::sin(phi[i]);
        float d[3];
        for (int a = 0; a < 3; a++) d[a] = u * frame[a] + v * frame[3 + a] + w * frame[6 + a];
        n[i] = march(f, ray_of(f, positions + 3 * hit[i], d));
    }
}
