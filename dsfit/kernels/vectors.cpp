// Sixteen float32 numbers at a time, and functions of them.
#include <cstdint>
#include <cstring>
#if defined(__AVX512F__)
#include <immintrin.h>
#endif

#define W 16
typedef float V __attribute__((vector_size(64)));
typedef int32_t I __attribute__((vector_size(64)));
#define INLINE static inline __attribute__((always_inline))

// Upper halves of vector registers that are left in use make SSE code that runs later tens of times slower; GCC 12
// forgets to clear them where it inlines calls through a lambda.
INLINE void leave_vectors() {
#if defined(__AVX__)
    __builtin_ia32_vzeroupper();
#endif
}

INLINE V all(float x) { return V{} + x; }
INLINE V load(const float* p) { V r; std::memcpy(&r, p, 64); return r; }
INLINE void store(float* p, V x) { std::memcpy(p, &x, 64); }
INLINE V vmin(V a, V b) { return a < b ? a : b; }
INLINE V vmax(V a, V b) { return a > b ? a : b; }
INLINE I bits(V x) { I r; std::memcpy(&r, &x, 64); return r; }
INLINE V real(I x) { V r; std::memcpy(&r, &x, 64); return r; }
INLINE V magnitude(V x) { return real(bits(x) & 0x7fffffff); }
INLINE V signed_like(V x, V sign) { return real(bits(x) | (bits(sign) & (I{} + (int32_t)0x80000000))); }
INLINE V number(I x) { return __builtin_convertvector(x, V); }
INLINE I whole(V x) { return __builtin_convertvector(x, I); }
INLINE I imin(I a, I b) { return a < b ? a : b; }

// fused_rest: x * x - square exactly
#if defined(__AVX512F__)
INLINE V fused_rest(V x, V square) { return (V)_mm512_fmsub_ps((__m512)x, (__m512)x, (__m512)square); }
INLINE V root(V x) { return (V)_mm512_sqrt_ps((__m512)x); }
INLINE V take(const float* p, I i) { return (V)_mm512_i32gather_ps((__m512i)i, p, 4); }
INLINE void put(float* p, I i, V x) { _mm512_i32scatter_ps(p, (__m512i)i, (__m512)x, 4); }
INLINE I take_pairs(const uint16_t* p, I i) { return (I)_mm512_i32gather_epi32((__m512i)i, p, 2); }
INLINE bool any(I x) { return _mm512_test_epi32_mask((__m512i)x, (__m512i)x) != 0; }
INLINE V inverse_root(V x) {
    V y = (V)_mm512_rsqrt14_ps((__m512)x);
    return y * (1.5f - 0.5f * x * y * y);
}
INLINE V inverse(V x) {
    V y = (V)_mm512_rcp14_ps((__m512)x);
    return y * (2.0f - x * y);
}
#else
INLINE V fused_rest(V x, V square) {
    V r;
    for (int l = 0; l < W; l++) r[l] = __builtin_fmaf(x[l], x[l], -square[l]);
    return r;
}
INLINE V root(V x) { V r; for (int l = 0; l < W; l++) r[l] = __builtin_sqrtf(x[l]); return r; }
INLINE V take(const float* p, I i) { V r; for (int l = 0; l < W; l++) r[l] = p[i[l]]; return r; }
INLINE void put(float* p, I i, V x) { for (int l = 0; l < W; l++) p[i[l]] = x[l]; }
INLINE I take_pairs(const uint16_t* p, I i) {
    I r;
    for (int l = 0; l < W; l++) r[l] = p[i[l]] | (int32_t)p[i[l] + 1] << 16;
    return r;
}
INLINE bool any(I x) {
    int32_t total = 0;
    for (int l = 0; l < W; l++) total |= x[l];
    return total;
}
INLINE V inverse_root(V x) { return 1.0f / root(x); }
INLINE V inverse(V x) { return 1.0f / x; }
#endif

// e^x, 0 below -87 (Cody-Waite reduction, polynomial of Cephes)
INLINE V expo(V x) {
    V y = vmin(vmax(x, all(-87.3f)), all(88.0f));
    V shifted = y * 1.44269504f + 12582912.0f;
    V n = shifted - 12582912.0f;
    V f = (y - n * 0.693359375f) + n * 2.12194440e-4f;
    V p = 1.9875691500e-4f * f + 1.3981999507e-3f;
    p = p * f + 8.3334519073e-3f;
    p = p * f + 4.1665795894e-2f;
    p = p * f + 1.6666665459e-1f;
    p = p * f + 5.0000001201e-1f;
    p = p * (f * f) + f + 1.0f;
    V scale = real((bits(shifted) - 0x4B400000 + 127) << 23);
    return x < -87.0f ? V{} : p * scale;
}

// log x of positive normal numbers (polynomial of Cephes)
INLINE V logarithm(V x) {
    I b = bits(x);
    V e = number((b >> 23) - 126);
    V m = real((b & 0x007fffff) | 0x3f000000);
    I low = m < 0.707106781186547524f;
    e = low ? e - 1.0f : e;
    m = (low ? m + m : m) - 1.0f;
    V z = m * m;
    V p = 7.0376836292e-2f * m - 1.1514610310e-1f;
    p = p * m + 1.1676998740e-1f;
    p = p * m - 1.2420140846e-1f;
    p = p * m + 1.4249322787e-1f;
    p = p * m - 1.6668057665e-1f;
    p = p * m + 2.0000714765e-1f;
    p = p * m - 2.4999993993e-1f;
    p = p * m + 3.3333331174e-1f;
    return (p * m * z - 2.12194440e-4f * e - 0.5f * z) + m + 0.693359375f * e;
}

// sin x for x in [0, pi/2]
INLINE V sine(V x) {
    V z = x * x;
    V p = -2.5052108e-8f * z + 2.7557319e-6f;
    p = p * z - 1.9841270e-4f;
    p = p * z + 8.3333333e-3f;
    p = p * z - 1.6666667e-1f;
    return x + x * z * p;
}

// cos x for |x| <= pi/2 with all digits at the ends; never 0 or negative, as frame.cos_inclination
INLINE V cosine(V x) {
    return vmax(sine(vmax((1.57079637f - magnitude(x)) - 4.37113883e-8f, V{})), all(1.42108547e-14f));
}

INLINE V arcsine(V v) {
    V a = magnitude(v);
    I big = a > 0.5f;
    V z = big ? (1.0f - a) * 0.5f : a * a;
    V x = big ? root(vmax(z, V{})) : a;
    V p = 4.2163199048e-2f * z + 2.4181311049e-2f;
    p = p * z + 4.5470025998e-2f;
    p = p * z + 7.4953002686e-2f;
    p = p * z + 1.6666752422e-1f;
    p = p * z * x + x;
    return signed_like(big ? 1.57079637f - (p + p) : p, v);
}

// normal.py
INLINE V upper_quantile(V y) {
    V w = -logarithm(vmax(y * (2.0f - y), all(1e-14f)));
    V p = all(-7.155819616e-09f);
    p = p * w + 1.88914308e-07f;
    p = p * w - 1.591124583e-06f;
    p = p * w - 6.607918076e-07f;
    p = p * w + 8.208768495e-05f;
    p = p * w - 0.0002139362175f;
    p = p * w - 0.003268174582f;
    p = p * w + 0.01631625781f;
    p = p * w + 0.3281200195f;
    p = p * w + 1.253314044f;
    V t = (root(vmax(w, all(6.25f))) - 4.1f) * 0.625f;
    static const float c[8] = {5.573054694f, 2.28473466f, 0.003671877968f, -0.004273630661f,
                               0.00237360244f, -0.001169801392f, 0.0004535794612f, -7.316103615e-05f};
    V q = all(c[7]);
    for (int k = 6; k >= 0; k--) q = q * t + c[k];
    return w < 6.25f ? p * (1.0f - y) : q;
}

template <int S> INLINE void swap_blocks(V* r) {
    I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    I high = (lane & S) != 0;
    I first = high ? lane - S + W : lane, second = high ? lane + W : lane + S;
    for (int i = 0; i < W; i++) {
        if (i & S) continue;
        V a = r[i], b = r[i + S];
        r[i] = __builtin_shuffle(a, b, first);
        r[i + S] = __builtin_shuffle(a, b, second);
    }
}

INLINE void transpose(V* r) {
    swap_blocks<8>(r);
    swap_blocks<4>(r);
    swap_blocks<2>(r);
    swap_blocks<1>(r);
}

// Every third number of 48, from the k-th on
INLINE V third(const V* x, int k) {
    I lane = {0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 33, 36, 39, 42, 45};
    I wanted = lane + k;
    V front = __builtin_shuffle(x[0], x[1], wanted & 31);
    V back = __builtin_shuffle(x[2], x[2], wanted & 15);
    return wanted < 2 * W ? front : back;
}

// erfc(x) for x >= 0 with relative error 1.2e-7 (Press et al., Numerical Recipes, section 6.2)
INLINE V complementary(V x) {
    V t = 2.0f / (2.0f + x);
    V p = 0.17087277f * t - 0.82215223f;
    p = p * t + 1.48851587f;
    p = p * t - 1.13520398f;
    p = p * t + 0.27886807f;
    p = p * t - 0.18628806f;
    p = p * t + 0.09678418f;
    p = p * t + 0.37409196f;
    p = p * t + 1.00002368f;
    p = p * t - 1.26551223f;
    V square = x * x;  // rounded off in the exponent, so that what is lost is put back
    V lost = fused_rest(x, square);
    return t * expo(p - square) * (1.0f - lost);
}
