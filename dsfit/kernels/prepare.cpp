// The mixtures of contexts, sixteen at a time, from tables and network: formulas and their names are those of
// LobeMoments, AmortisedProposal.shape and contexts.mixture_fields. Shares of zero have the log energy NOTHING.
#define NEAR (3 + BACK_LOBE)
#define FAR (5 + BACK_LOBE)
#define LOBES (8 + BACK_LOBE)
#define NOTHING -1e30f
#define NEAR_RECORD 16
#define FAR_RECORD 32
#define FEATURES 10

struct Start {
    const float *direct, *scattered, *depths, *network;
    const int32_t* sizes;
    int32_t layers, widest, rows, levels;
    float log_share, low, high;
};

// Weights, modes and widths of the K components
struct Shape {
    V log_weight[K], mode[K], below[K], above[K];
};

INLINE V between(V a, V b, V t) { return a + (b - a) * t; }

// Rows of `near` are [4, NEAR] and those of `far` [4, FAR]: log energies, modes, log widths below and above
INLINE void look_up_moments(const Start& s, V theta_r, V n, V* near, V* far) {
    V position = vmin(vmax(theta_r * 0.318309886f + 0.5f, V{}), all(1.0f)) * (float)(s.rows - 1);
    I row = imin(whole(position), I{} + (s.rows - 2)), level{};
    V across = position - number(row);
    for (int k = 1; k < s.levels - 1; k++) level -= n >= s.depths[k];
    V low = take(s.depths, level), along = (n - low) / (take(s.depths, level + 1) - low), inside = vmin(along, all(1.0f));
    I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    for (int l = 0; l < W; l++) {
        V x = all(across[l]), held = all(inside[l]);
        const float* p = s.direct + row[l] * NEAR_RECORD;
        near[l] = between(load(p), load(p + NEAR_RECORD), x);
        const float* q = s.scattered + (row[l] * s.levels + level[l]) * FAR_RECORD;
        for (int part = 0; part < 2; part++, q += W) {
            const float* r = q + s.levels * FAR_RECORD;
            V before = between(load(q), load(r), x), after = between(load(q + FAR_RECORD), load(r + FAR_RECORD), x);
            // energies go on beyond the last depth
            far[part * W + l] = between(before, after, part == 0 && FAR ? (lane < FAR ? all(along[l]) : held) : held);
        }
    }
    transpose(near);
    transpose(far);
    transpose(far + W);
}

template <int N> INLINE V log_sum(const V* x) {
    V top = x[0], sum{};
    for (int k = 1; k < N; k++) top = vmax(top, x[k]);
    for (int k = 0; k < N; k++) sum += expo(x[k] - top);
    return top + logarithm(sum);
}

INLINE V log_share(V share) { return share > 0.0f ? logarithm(share) : all(NOTHING); }
INLINE V soft(V x) { return x * inverse_root(1.0f + x * x); }
INLINE V bounded(V x, float bound) { return bound * soft(x * (1.0f / bound)); }
INLINE V limited_ratio(V x) { return soft(vmin(vmax(x, all(-100.0f)), all(100.0f)) * (1.0f / 3.0f)); }

INLINE void features(V theta_r, V n, V v, const V* near, const V* far, V* x) {
    V cos = cosine(theta_r), sin = signed_like(sine(vmin(magnitude(theta_r), all(1.57079637f))), theta_r);
    V others[3] = {far[0], far[3], far[4]};
    x[0] = theta_r * 0.636619772f;
    x[1] = 2.0f * sin * cos;
    x[2] = cos;
    x[3] = theta_r / (cos + 0.15f) * 0.2f;
    x[4] = logarithm(1.0f + n) * (1.0f / 3.0f);
    x[5] = n / (n + 4.0f);
    x[6] = far[2 * FAR + 1] + 1.0f;
    x[7] = v;
    x[8] = limited_ratio(log_sum<NEAR>(near) - log_sum<FAR>(far) + log_share(v) - log_share(1.0f - v));
    x[9] = limited_ratio(far[1] - log_sum<3>(others));
}

// Outputs come in eights; per layer the biases, then weights [inputs, outputs]
INLINE const float* layer(const float* p, const V* x, int inputs, int outputs, V* y) {
    for (int o = 0; o < outputs; o += 8) {
        V sum[8];
        for (int r = 0; r < 8; r++) sum[r] = all(p[o + r]);
        const float* w = p + outputs + o;
        for (int i = 0; i < inputs; i++, w += outputs)
            for (int r = 0; r < 8; r++) sum[r] += x[i] * w[r];
        for (int r = 0; r < 8; r++) y[o + r] = sum[r];
    }
    return p + outputs * (inputs + 1);
}

// The output lies in x: [4, K] corrections of modes, widths below and above, log weights
INLINE void network(const Start& s, V* x, V* y) {
    const float* p = s.network;
    for (int k = 0; k < s.layers; k++) {
        int inputs = s.sizes[k], outputs = (s.sizes[k + 1] + 7) & ~7;
        if (k)
            for (int i = 0; i < inputs; i++) x[i] = soft(x[i]);
        p = layer(p, x, inputs, outputs, y);
        for (int i = 0; i < outputs; i++) x[i] = y[i];
    }
}

// Moments [4, LOBES] of the lobes' shares of the light; back scattering of both kinds is one lobe
INLINE void shared(const V* near, const V* far, V v, V* m) {
    V lit = log_share(v), unlit = log_share(1.0f - v);
    for (int f = 0; f < 4; f++) {
        for (int k = 0; k < 3; k++) m[f * LOBES + k] = near[f * NEAR + k] + (f ? V{} : lit);
        for (int k = 0; k < 5; k++) m[f * LOBES + 3 + k] = far[f * FAR + k] + (f ? V{} : unlit);
    }
#if BACK_LOBE
    V a = near[3] + lit, b = far[5] + unlit;
    m[8] = vmax(a, b) + logarithm(1.0f + expo(-magnitude(a - b)));
    V share = 1.0f / (1.0f + expo(b - a));
    for (int f = 1; f < 4; f++) m[f * LOBES + 8] = between(far[f * FAR + 5], near[f * NEAR + 3], share);
#endif
}

static void shape_at(const Start& s, V theta_r, V n, V v, Shape& out) {
    V near[NEAR_RECORD], far[FAR_RECORD], m[4 * LOBES], x[s.widest], y[s.widest];
    look_up_moments(s, theta_r, n, near, far);
    features(theta_r, n, v, near, far, x);
    network(s, x, y);
    shared(near, far, v, m);
    V total = log_sum<LOBES>(m);
    for (int k = 0; k < K; k++) {
        bool wide = COMPONENT[k] == LOBES;
        int lobe = wide ? 0 : COMPONENT[k];
        V energy = wide ? all(-4.60517019f) : m[lobe] - total;
        V mean = wide ? V{} : m[LOBES + lobe];
        V below = wide ? all(-0.510825624f) : m[2 * LOBES + lobe], above = wide ? below : m[3 * LOBES + lobe];
        out.log_weight[k] = energy + x[3 * K + k];
        out.mode[k] = mean + expo(0.5f * (below + above)) * bounded(x[k], 4.0f);
        out.below[k] = vmin(vmax(expo(below + bounded(x[K + k], 3.0f)), all(s.low)), all(s.high));
        out.above[k] = vmin(vmax(expo(above + bounded(x[2 * K + k], 3.0f)), all(s.low)), all(s.high));
    }
    V whole_weight = log_sum<K>(out.log_weight) - s.log_share;
    for (int k = 0; k < K; k++) out.log_weight[k] = out.log_weight[k] - whole_weight;
}

INLINE V limited(V width, V distance) {
    V reach = 4.0f * width;
    return distance > reach ? reach * width / distance : width;
}

// contexts.mixture_fields: [10, K, stride] at `out`
static void write_fields(V theta_r, const Shape& shape, float* out, int64_t stride) {
    V half = theta_r * 0.5f, low = half - 0.785398163f, high = half + 0.785398163f, edge{};
    for (int k = 0; k < K; k++) {
        V mode = shape.mode[k], split = vmin(vmax(mode, low), high);
        V over = vmax(mode - split, V{}), under = vmax(split - mode, V{});
        V below = limited(shape.below[k], over), above = limited(shape.above[k], under);
        mode = split + vmin(over, 4.0f * below) - vmin(under, 4.0f * above);
        V inverse_below = 0.707106781f / below, inverse_above = 0.707106781f / above;
        V near_left = complementary(vmax(mode - split, V{}) * inverse_below);
        V far_left = complementary(vmax(mode - low, V{}) * inverse_below);
        V near_right = complementary(vmax(split - mode, V{}) * inverse_above);
        V far_right = complementary(vmax(high - mode, V{}) * inverse_above);
        V left = split > low ? below * (near_left - far_left) : V{};
        V right = split < high ? above * (near_right - far_right) : V{};
        V mass = left + right, log_weight = vmax(shape.log_weight[k], all(NOTHING));
        edge += expo(log_weight);
        V found[10] = {mode,        inverse_below, inverse_above, log_weight - logarithm(5.01325655f * mass), edge,
                       left / mass, far_left,      near_left,     far_right, near_right};
        for (int f = 0; f < 10; f++) store(out + (f * K + k) * stride, found[f]);
    }
}

// The first `count` <= 16 numbers, the last of them repeated
INLINE V load_some(const float* p, int64_t count) {
    V r;
    for (int l = 0; l < W; l++) r[l] = p[l < count ? l : count - 1];
    return r;
}

// Blocks of sixteen contexts for `body(block's contexts [3], first, fields, stride)`; fewer are filled up
template <typename F>
INLINE void each_block(const float* const* context, int64_t count, int64_t total, float* out, F body) {
    if (!count) return;
    if (count < W) {
        float fields[10 * K * W];
        V c[3];
        for (int q = 0; q < 3; q++) c[q] = load_some(context[q], count);
        body(c, 0, fields, (int64_t)W);
        for (int row = 0; row < 10 * K; row++) std::memcpy(out + row * total, fields + row * W, count * sizeof(float));
        return;
    }
    for (int64_t block = 0; block < count; block += W) {
        int64_t b = block + W > count ? count - W : block;
        V c[3] = {load(context[0] + b), load(context[1] + b), load(context[2] + b)};
        body(c, b, out + b, total);
    }
}

// Directions of many contexts, `samples` of each, prepared, drawn and evaluated block by block
struct Shading {
    const float *theta_r, *n, *v, *u;
    float *theta_i, *phi, *pdf, *value;
    int64_t samples, batch;
    float sphere;
};

static void run_shade(const Tables& t, const Start& s, const Shading& r, const int32_t* index, int64_t count) {
    float fields[10 * K * W], numbers[3 * W];
    Context c = {numbers, numbers + W, numbers + 2 * W, fields, W, r.sphere};
    for (int64_t block = 0; block < count; block += W) {
        I i;
        for (int l = 0; l < W; l++) i[l] = index[block + l < count ? block + l : count - 1];
        V theta_r = take(r.theta_r, i), n = take(r.n, i), v = take(r.v, i);
        Shape shape;
        shape_at(s, theta_r, n, v, shape);
        write_fields(theta_r, shape, fields, W);
        store(numbers, theta_r);
        for (int64_t k = 0; k < r.samples; k++) {
            int64_t first = k * r.batch;
            V x, y, us[3], record[WIDTH], value[CHANNELS];
            for (int q = 0; q < 3; q++) us[q] = take(r.u + 3 * first, 3 * i + q);
            draw<false>(t, c, 0, us, &x, &y);
            Direction d = at(x, y, theta_r);
            look_up(t, d, record);
            put(r.theta_i + first, i, x);
            put(r.phi + first, i, y);
            put(r.pdf + first, i, density<false>(c, 0, d, record));
            evaluate(t, d, record, n, v, value);
            for (int q = 0; q < CHANNELS; q++) put(r.value + q * r.samples * r.batch + first, i, value[q]);
        }
    }
}

extern "C" {
// Mixture fields of log weights, modes and widths below and above, each [count, `every`], of which COMPONENT are taken;
// rows of `out` hold `total` contexts
void dsfit_fields(const float* theta_r, const float* const* given, int64_t every, int64_t count, int64_t total,
                  float* out) {
    const float* context[3] = {theta_r, theta_r, theta_r};
    each_block(context, count, total, out, [&](const V* c, int64_t b, float* fields, int64_t stride) {
        Shape shape;
        V* rows[4] = {shape.log_weight, shape.mode, shape.below, shape.above};
        for (int f = 0; f < 4; f++)
            for (int k = 0; k < K; k++)
                for (int l = 0; l < W; l++) {
                    int64_t last = b + l < count ? b + l : count - 1;
                    rows[f][k][l] = given[f][last * every + COMPONENT[k]];
                }
        write_fields(c[0], shape, fields, stride);
    });
    leave_vectors();
}

void dsfit_prepare(const Start* s, const float* theta_r, const float* n, const float* v, int64_t count, float* out) {
    const float* context[3] = {theta_r, n, v};
    each_block(context, count, count, out, [&](const V* c, int64_t, float* fields, int64_t stride) {
        Shape shape;
        shape_at(*s, c[0], c[1], c[2], shape);
        write_fields(c[0], shape, fields, stride);
    });
    leave_vectors();
}

// How many contexts need both halves, the direct and the scattered one, and (unless `index` is null) which,
// [3, count]; false where one is not valid
int32_t dsfit_sort(const float* theta_r, const float* n, const float* v, int64_t count, int32_t* index,
                   int64_t* counts) {
    int64_t found[3] = {0, 0, 0};  // without branches, which would be mispredicted
    int32_t valid = 1;
    for (int64_t b = 0; b < count; b++) {
        valid &= (__builtin_fabsf(theta_r[b]) <= 1.57079637f) & (n[b] >= 0) & (n[b] < __builtin_inff());
        valid &= (v[b] >= 0) & (v[b] <= 1);
        int lit = v[b] == 1, unlit = v[b] == 0;
        if (index)
            for (int k = 0; k < 3; k++) index[k * count + found[k]] = (int32_t)b;
        found[0] += !(lit | unlit);
        found[1] += lit;
        found[2] += unlit;
    }
    std::memcpy(counts, found, sizeof found);
    return valid;
}

void dsfit_shade(const Tables* t, const Start* s, const Shading* r, const int32_t* index, int64_t count) {
    run_shade(*t, *s, *r, index, count);
}
}
