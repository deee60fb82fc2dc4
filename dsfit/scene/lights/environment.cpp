// An environment map's radiance, sampling and density in many fibre frames. Directions are float32, the arithmetic on
// them double. Follows dsfit/scene/lights/environment.py. Loops of fixed length N without branches become vectors;
// searches and look-ups in between go one by one.
#include <cmath>
#include <cstdint>
#include <cstring>

#define N 32
#define EACH for (int l = 0; l < N; l++)
#define INLINE static inline __attribute__((always_inline))

static const double PI = 3.14159265358979323846, TINY = 2.2250738585072014e-308;

struct Map {
    const double *luminance, *column_mass, *row_values, *row_mass, *rises;  // as the light's tables
    const double *low, *high, *cosine;  // 1 - cos, 1 + cos and cos of the colatitudes of the nodes, [H + 2]
    const float* image;                 // [H][W + 1][stride], times scale; the last column repeats the first
    const int32_t* row_guide;           // [row_buckets + 1]: last row interval that starts within i / row_buckets
    const int32_t* column_guide;        // [H][buckets + 1]: the same for the columns of each row; -1: the row is black
    int64_t height, width, channels, stride, row_buckets, buckets;
};

typedef double D[N];
struct Place { D t, s, column, row, cosine; int32_t k[N], j[N]; };

// (sin x, cos x) by Taylor's series within pi / 4 of a multiple of pi / 2.
INLINE void sine_cosine(double x, double& sine, double& cosine) {
    double q = std::floor(x * (2 / PI) + 0.5), half = std::floor(q * 0.5), odd = q - 2 * half;
    double sign = 1 - 2 * (half - 2 * std::floor(half * 0.5));
    double r = (x - q * 1.5707963267948966) - q * 6.123233995736766e-17, z = r * r;
    double s = -1. / 39916800 + z * (1. / 6227020800);
    s = r + r * z * (-1. / 6 + z * (1. / 120 + z * (-1. / 5040 + z * (1. / 362880 + z * s))));
    double c = -1. / 3628800 + z * (1. / 479001600 - z * (1. / 87178291200));
    c = 1 + z * (-0.5 + z * (1. / 24 + z * (-1. / 720 + z * (1. / 40320 + z * c))));
    sine = sign * (odd * c + (1 - odd) * s);
    cosine = sign * ((1 - odd) * c - odd * s);
}

// atan2 to 1e-12; the polynomial interpolates atan(sqrt z) / sqrt z at Chebyshev nodes of [0, 1].
INLINE double angle(double y, double x) {
    double ax = std::fabs(x), ay = std::fabs(y);
    double most = ax > ay ? ax : ay, least = ax > ay ? ay : ax;
    double q = least / (most > 1e-300 ? most : 1e-300), z = q * q;
    double p = 0.00017039676507314046;
    p = p * z - 0.0014662203689416249; p = p * z + 0.0059349580357472096; p = p * z - 0.015229828127970295;
    p = p * z + 0.028407310326762549; p = p * z - 0.042321774252847423; p = p * z + 0.054580653603342924;
    p = p * z - 0.065361524366736978; p = p * z + 0.076631535292091074; p = p * z - 0.090863554876155966;
    p = p * z + 0.11110640040352462; p = p * z - 0.1428568459346683; p = p * z + 0.19999999010049285;
    p = p * z - 0.33333333320182362; p = p * z + 0.99999999999970668;
    double a = q * p;
    a = ay > ax ? PI / 2 - a : a;
    a = x < 0 ? PI - a : a;
    return std::copysign(a, y);
}

// Quantile of the density proportional to a + (b - a) x on [0, 1].
INLINE double linear_inverse(double u, double a, double b) {
    double square = (1 - u) * a * a + u * b * b;
    double x = u * (a + b) / (a + std::sqrt(square > TINY ? square : TINY));
    return x < 0 ? 0 : x > 1 ? 1 : x;
}

// Matrices, world to fibre, of the block's directions; frame i % frames belongs to direction i.
INLINE void frames_of(const float* rotation, int64_t frames, int64_t first, D* matrix) {
    int64_t at = first % frames;
    for (int l = 0; l < N; l++) {
        for (int e = 0; e < 9; e++) matrix[e][l] = rotation[9 * at + e];
        if (++at == frames) at = 0;
    }
}

// Where directions [count][2] of the block lie in the map.
INLINE void place(const Map& m, const float* rotation, int64_t frames, const float* omega, int64_t first, int64_t count,
                  Place& p) {
    D matrix[9], theta, phi;
    frames_of(rotation, frames, first, matrix);
    EACH {
        int64_t i = first + (l < count ? l : 0);
        theta[l] = omega[2 * i];
        phi[l] = omega[2 * i + 1];
    }
    const double height = (double)m.height, width = (double)m.width;
    EACH {
        double st, ct, sp, cp;
        sine_cosine(theta[l], st, ct);
        sine_cosine(phi[l], sp, cp);
        ct = ct > 1.4210854715202004e-14 ? ct : 1.4210854715202004e-14;  // as `cos_inclination`
        double v = ct * cp, w = ct * sp;
        double x = matrix[0][l] * st + matrix[3][l] * v + matrix[6][l] * w;
        double y = matrix[1][l] * st + matrix[4][l] * v + matrix[7][l] * w;
        double z = matrix[2][l] * st + matrix[5][l] * v + matrix[8][l] * w;
        double flat = x * x + z * z;
        p.cosine[l] = y / std::sqrt(flat + y * y);
        double row = angle(std::sqrt(flat), y) * (height / PI) - 0.5;
        double column = (PI - angle(x, z)) * (width / (2 * PI)) - 0.5;
        double k = std::floor(row), j = std::floor(column);
        double t = row - k, s = column - j;
        k = k + 1;
        // Half rows at the poles: one value in all of them.
        t = k <= 0 || k >= height ? 0.5 : t;
        k = k < 0 ? 0 : k > height ? height : k;
        j = j < 0 ? j + width : j;
        j = j >= width ? j - width : j;
        p.t[l] = t;
        p.s[l] = s;
        p.row[l] = k;
        p.column[l] = j;
    }
    EACH { p.k[l] = (int32_t)p.row[l]; p.j[l] = (int32_t)p.column[l]; }
}

INLINE int64_t above(int64_t k) { return k > 0 ? k - 1 : 0; }
INLINE int64_t below(const Map& m, int64_t k) { return k < m.height ? k : m.height - 1; }

typedef float F4 __attribute__((vector_size(16)));
INLINE F4 load(const float* p) { F4 r; std::memcpy(&r, p, 16); return r; }

extern "C" void dsfit_environment_radiance(const Map* map, const float* rotation, int64_t frames, const float* omega,
                                           int64_t count, float* radiance) {
    const Map m = *map;
    const int64_t line = (m.width + 1) * m.stride, channels = m.channels;
    Place p;
    for (int64_t first = 0; first < count; first += N) {
        const int64_t left = count - first < N ? count - first : N;
        place(m, rotation, frames, omega, first, left, p);
        for (int l = 0; l < left; l++) {
            const float *top = m.image + above(p.k[l]) * line + p.j[l] * m.stride;
            const float *bottom = m.image + below(m, p.k[l]) * line + p.j[l] * m.stride;
            const float t = (float)p.t[l], s = (float)p.s[l], r = (float)(1 - p.t[l]), q = (float)(1 - p.s[l]);
            float* out = radiance + (first + l) * channels;
            if (m.stride == 1) {
                *out = r * (q * top[0] + s * top[1]) + t * (q * bottom[0] + s * bottom[1]);
                continue;
            }
            for (int64_t c = 0; c < channels; c += 4) {
                F4 value = r * (q * load(top + c) + s * load(top + m.stride + c)) +
                           t * (q * load(bottom + c) + s * load(bottom + m.stride + c));
                const int64_t rest = channels - c;
                if (rest == 3) std::memcpy(out + c, &value, 12);
                else std::memcpy(out + c, &value, 4 * (rest < 4 ? rest : 4));
            }
        }
    }
}

extern "C" void dsfit_environment_log_prob(const Map* map, const float* rotation, int64_t frames, const float* omega,
                                           int64_t count, float* log_prob) {
    const Map m = *map;
    const double total = m.row_mass[m.height + 1];
    Place p;
    for (int64_t first = 0; first < count; first += N) {
        const int64_t left = count - first < N ? count - first : N;
        place(m, rotation, frames, omega, first, left, p);
        for (int l = 0; l < left; l++) {
            const int64_t k = p.k[l], j = p.j[l], after = j + 1 == m.width ? 0 : j + 1;
            const double *top = m.luminance + above(k) * m.width, *bottom = m.luminance + below(m, k) * m.width;
            const double s = p.s[l];
            const double one = (1 - s) * top[j] + s * top[after], two = (1 - s) * bottom[j] + s * bottom[after];
            // Place in the row measured in sin(latitude). Rounding takes neither weight to zero: the radiance has both.
            double near = (m.cosine[k] - p.cosine[l]) / m.rises[k];
            near = near < 1e-12 ? 1e-12 : near > 1 - 1e-12 ? 1 - 1e-12 : near;
            log_prob[first + l] = (float)std::log(((1 - near) * one + near * two) / total);
        }
    }
}

INLINE int64_t column_bucket(const Map& m, double u) {
    const int64_t bucket = (int64_t)(u * (double)m.buckets);
    return bucket < m.buckets ? bucket : m.buckets - 1;
}

struct Row { int64_t k; double target; };

INLINE Row find_row(const Map& m, double u) {
    const int64_t buckets = m.row_buckets;
    const double total = m.row_mass[m.height + 1];
    double target = u * total;  // strictly below the total: a trailing row without mass is never chosen
    if (!(target < total)) target = std::nextafter(total, 0.0);
    const int64_t bucket = (int64_t)(u * (double)buckets);
    int64_t k = m.row_guide[bucket < buckets ? bucket : buckets - 1];
    while (k > 0 && m.row_mass[k] > target) k--;
    while (m.row_mass[k + 1] <= target) k++;
    return {k, target};
}

struct Column { int64_t j; double start, goal; };
struct Bounds { int64_t low, high; };

INLINE const int32_t* guide_at(const Map& m, int64_t row, double u) {
    return m.column_guide + row * (m.buckets + 1) + column_bucket(m, u);
}

// Columns between which that of the quantile u lies, in a row interpolated between k and k + 1: it lies between those
// of the two rows alone, which the guides bound.
INLINE Bounds column_bounds(const Map& m, int64_t k, double u) {
    const int32_t *first = guide_at(m, above(k), u), *second = guide_at(m, below(m, k), u);
    int32_t a = first[0], b = second[0], c = first[1], d = second[1];
    if (a < 0) a = b, c = d;
    if (b < 0) b = a, d = c;
    return {a < b ? a : b, (c > d ? c : d) + 1};
}

// The last column whose mass, interpolated between the two rows, does not exceed u of the whole.
INLINE Column find_column(const Map& m, int64_t k, double t, double u, Bounds bounds) {
    const int64_t width = m.width;
    const double *one = m.column_mass + above(k) * (width + 1), *two = m.column_mass + below(m, k) * (width + 1);
    const double rest = 1 - t;
    auto mass = [&](int64_t j) { return rest * one[j] + t * two[j]; };
    const double full = mass(width);
    double goal = u * full;
    if (!(goal < full)) goal = std::nextafter(full, 0.0);
    int64_t low = bounds.low > 0 ? bounds.low : 0, high = bounds.high;
    double start = mass(low);
    if (start > goal) { low = 0; start = mass(0); }  // rounding at the border of a bucket
    if (mass(high) <= goal) high = width;
    while (high - low > 1) {
        const int64_t middle = (low + high) / 2;
        const double found = mass(middle);
        const bool further = found <= goal;
        low = further ? middle : low;
        start = further ? found : start;
        high = further ? high : middle;
    }
    return {low, start, goal};
}

// Directions [count][2] from uniforms [count][step].
extern "C" void dsfit_environment_sample(const Map* map, const float* rotation, int64_t frames, const float* u,
                                         int64_t step, int64_t count, float* omega) {
    const Map m = *map;
    D matrix[9], fraction, a, b, rise, low, high, t, sine, cosine, column, theta, phi;
    int64_t k[N];
    Bounds bounds[N];
    for (int64_t first = 0; first < count; first += N) {
        const int64_t left = count - first < N ? count - first : N;
        frames_of(rotation, frames, first, matrix);
        EACH {
            const float* given = u + step * (first + (l < left ? l : 0));
            const Row r = find_row(m, given[0]);
            // What the loops below read is asked for one loop ahead.
            __builtin_prefetch(guide_at(m, above(r.k), given[1]));
            __builtin_prefetch(guide_at(m, below(m, r.k), given[1]));
            k[l] = r.k;
            fraction[l] = (r.target - m.row_mass[r.k]) / (m.row_mass[r.k + 1] - m.row_mass[r.k]);
            a[l] = m.row_values[r.k];
            b[l] = m.row_values[r.k + 1];
            rise[l] = m.rises[r.k];
            low[l] = m.low[r.k];
            high[l] = m.high[r.k + 1];
        }
        EACH {
            t[l] = linear_inverse(fraction[l], a[l], b[l]);
            // 1 - cos and 1 + cos of the colatitude, each without cancellation at its own pole
            double from = low[l] + t[l] * rise[l], to = high[l] + (1 - t[l]) * rise[l];
            sine[l] = std::sqrt(from * to);
            cosine[l] = 1 - from;
        }
        EACH {
            bounds[l] = column_bounds(m, k[l], u[step * (first + (l < left ? l : 0)) + 1]);
            const int64_t middle = (bounds[l].low + bounds[l].high) / 2, up = above(k[l]), down = below(m, k[l]);
            __builtin_prefetch(m.column_mass + up * (m.width + 1) + middle);
            __builtin_prefetch(m.column_mass + down * (m.width + 1) + middle);
            __builtin_prefetch(m.luminance + up * m.width + middle);
            __builtin_prefetch(m.luminance + down * m.width + middle);
        }
        EACH {
            const Column c = find_column(m, k[l], t[l], u[step * (first + (l < left ? l : 0)) + 1], bounds[l]);
            const double *one = m.luminance + above(k[l]) * m.width, *two = m.luminance + below(m, k[l]) * m.width;
            const int64_t after = c.j + 1 == m.width ? 0 : c.j + 1;
            a[l] = (1 - t[l]) * one[c.j] + t[l] * two[c.j];
            b[l] = (1 - t[l]) * one[after] + t[l] * two[after];
            fraction[l] = c.goal - c.start;
            column[l] = (double)c.j;
        }
        EACH {
            double part = fraction[l] * 2 / (a[l] + b[l]);
            part = part < 1 ? part : 1;
            double longitude = PI - (column[l] + linear_inverse(part, a[l], b[l]) + 0.5) * (2 * PI / (double)m.width);
            double along, across;
            sine_cosine(longitude, across, along);
            double x = sine[l] * across, y = cosine[l], z = sine[l] * along;
            double f0 = matrix[0][l] * x + matrix[1][l] * y + matrix[2][l] * z;
            double f1 = matrix[3][l] * x + matrix[4][l] * y + matrix[5][l] * z;
            double f2 = matrix[6][l] * x + matrix[7][l] * y + matrix[8][l] * z;
            theta[l] = angle(f0, std::sqrt(f1 * f1 + f2 * f2));
            phi[l] = angle(f2, f1);
        }
        for (int l = 0; l < left; l++) {
            omega[2 * (first + l)] = (float)theta[l];
            omega[2 * (first + l) + 1] = (float)phi[l];
        }
    }
}

// Last of `count` intervals whose start, in the cumulative sums [count + 1], does not exceed i / buckets of the whole.
extern "C" void dsfit_environment_guide(const double* sums, int64_t rows, int64_t count, int64_t buckets,
                                        int32_t* guide) {
    for (int64_t row = 0; row < rows; row++, sums += count + 1, guide += buckets + 1) {
        int64_t j = 0;
        for (int64_t i = 0; i <= buckets; i++) {
            const double goal = (double)i / (double)buckets * sums[count];
            while (j + 1 < count && sums[j + 1] <= goal) j++;
            guide[i] = sums[count] > 0 ? (int32_t)j : -1;
        }
    }
}
