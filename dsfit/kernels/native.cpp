// Value, density and draws of one fibre, sixteen directions at a time. The layout (macros and arrays) and vectors.cpp
// are put in front of this file when it is compiled; formulas and their names are those of evaluate.py, density.py and
// draw.py.
struct Tables {
    const float *constants, *records, *averages, *density, *cumulative;
    const uint16_t* guide;
};

struct Context {
    const float *theta_r, *n, *v, *fields;
    int64_t count;
    float sphere;
};

// One context for all directions, or one for each
template <bool SINGLE> INLINE V of(const float* p, int64_t b) { return SINGLE ? all(p[0]) : load(p + b); }

template <bool SINGLE> INLINE V field(const Context& c, int f, int k, int64_t b) {
    return of<SINGLE>(c.fields + (f * K + k) * c.count, b);
}

struct Direction {
    V theta_i, theta_h, diff, phi, cos_i, cos_diff;
};

INLINE Direction at(V theta_i, V phi, V theta_r) {
    Direction d;
    d.theta_i = theta_i;
    d.theta_h = (theta_i + theta_r) * 0.5f;
    d.diff = magnitude((theta_r - theta_i) * 0.5f);
    V turns = (phi * 0.159154943f + 12582912.0f) - 12582912.0f;
    d.phi = magnitude(phi - turns * 6.28318531f);
    d.cos_i = cosine(theta_i);
    d.cos_diff = cosine(d.diff);
    return d;
}

// Records of the sixteen directions, one quantity per row
INLINE void look_up(const Tables& t, const Direction& d, V* rows) {
    V x = vmin(d.diff * ((ROWS - 1) / 1.57079633f), all(ROWS - 1));
    V y = vmin(d.phi * ((COLUMNS - 1) / 3.14159265f), all(COLUMNS - 1));
    I i = imin(whole(x), I{} + (ROWS - 2)), j = imin(whole(y), I{} + (COLUMNS - 2));
    I first = i * COLUMNS + j;
    V across = x - number(i), along = y - number(j);
#if WIDTH == 8
    // one load holds two neighbours along phi
    V both[W];
    for (int l = 0; l < W; l++) {
        const float* p = t.records + (int64_t)first[l] * WIDTH;
        V low = load(p), high = load(p + COLUMNS * WIDTH);
        both[l] = low + (high - low) * across[l];
    }
    transpose(both);
    for (int k = 0; k < WIDTH; k++) rows[k] = both[k] + (both[k + WIDTH] - both[k]) * along;
#else
    for (int part = 0; part < WIDTH / W; part++) {
        for (int l = 0; l < W; l++) {
            const float* p = t.records + (int64_t)first[l] * WIDTH + part * W;
            V low = load(p), next_low = load(p + WIDTH);
            V high = load(p + COLUMNS * WIDTH), next_high = load(p + (COLUMNS + 1) * WIDTH);
            V below = low + (next_low - low) * along[l], above = high + (next_high - high) * along[l];
            rows[part * W + l] = below + (above - below) * across[l];
        }
        transpose(rows + part * W);
    }
#endif
}

INLINE void look_up_averages(const Tables& t, V theta_i, V* rows) {
    V gap = root(vmax(1.0f - magnitude(theta_i) * 0.636619772f, V{}));
    V y = (1.0f + signed_like(1.0f - gap, theta_i)) * ((KNOTS - 1) * 0.5f);
    I j = imin(whole(y), I{} + (KNOTS - 2));
    V x = y - number(j);
    for (int part = 0; part < AVERAGES / W; part++) {
        for (int l = 0; l < W; l++) {
            const float* p = t.averages + j[l] * AVERAGES + part * W;
            V low = load(p), high = load(p + AVERAGES);
            rows[part * W + l] = low + (high - low) * x[l];
        }
        transpose(rows + part * W);
    }
}

INLINE V gauss(V x, V variance, V log_scale) {
    V r = inverse_root(variance);
    return expo(log_scale - 0.5f * (x * x) * (r * r)) * (r * 0.398942280f);
}

INLINE V transmitted(V cosine, float eta) {
    V g = root((eta - 1) * (eta + 1) + cosine * cosine), p = eta * eta * cosine;
    V a = inverse(cosine + g), b = inverse(p + g);
    return 2.0f * g * (cosine * (a * a) + p * (b * b));
}

INLINE V closed_r(const Direction& d, V cos_half, float eta) {
    return (1.0f - transmitted(d.cos_diff * cos_half, eta)) * cos_half * 0.25f;
}

INLINE void closed_tt(const Direction& d, V sin_half, V cos_half, const float* c, V* value) {
    float eta = c[0];
    V over = inverse_root((eta - 1) * (eta + 1) + d.cos_diff * d.cos_diff);
    V kappa = d.cos_diff * over, gap = sin_half - kappa;
    V scale = inverse_root(gap * gap + cos_half * cos_half);
    V cos_gamma = vmin(vmax(gap * scale, V{}), all(1.0f)), inner = kappa * cos_half * scale;
    V cos_t = root(vmax((1.0f - inner) * (1.0f + inner), V{}));
    V spread = cos_gamma * cos_t * (kappa * cos_gamma + cos_t) / ((1.0f - kappa) * (1.0f + kappa));
    V passed = transmitted(d.cos_diff * cos_gamma, eta);
    V common = passed * passed * spread * 0.25f, depth = -2.0f * eta * cos_t * over;
    for (int k = 0; k < CHANNELS; k++) value[k] = common * expo(depth * c[11 + k]);
}

#if POISSON
// (1 - e^-x) / x
INLINE V mean_exponential(V x) {
    V series = all(1.0f), small = vmin(x, all(1.0f));
    for (int k = 11; k > 1; k--) series = 1.0f - small * series * (1.0f / k);
    return x < 1.0f ? series : (1.0f - expo(-x)) * inverse(vmax(x, all(1.0f)));
}
#endif

// Log transmittance and count of events of n fibres that pass on exp(log_a) each: forward.py
INLINE void forward(V log_a, V n, V over_n, V* log_passed, V* events) {
#if POISSON
    V a = expo(log_a), gap = log_a > -1.0f ? -log_a * mean_exponential(-log_a) : 1.0f - a;
    V mean = mean_exponential(n * a);
    *log_passed = log_a - n * gap + logarithm(mean * over_n);
    *events = inverse(mean);
#else
    *log_passed = n * log_a;
    *events = n;
#endif
}

INLINE V in_back(const Direction& d, V value) { return HALF_BACK ? (d.phi < 1.57079633f ? value : V{}) : value; }

INLINE void evaluate(const Tables& t, const Direction& d, const V* record, V n, V v, V* total) {
    const float* c = t.constants;
    const float *alpha = c + 5, *variance = c + 8;
    V average[AVERAGES];
    if (D_BACK || S_ANY) look_up_averages(t, d.theta_i, average);
    const V *log_a = average, *beta2 = log_a + CHANNELS, *a_b = beta2 + CHANNELS, *delta = a_b + CHANNELS;
    const V* sigma2 = delta + CHANNELS;
    for (int k = 0; k < CHANNELS; k++) total[k] = V{};
    if (D_R || D_TT || D_TRT || D_BACK) {
        V sin_half = sine(d.phi * 0.5f), cos_half = cosine(d.phi * 0.5f), tt[CHANNELS];
        if (D_R) {
            V lobe = gauss(d.theta_h - alpha[0], all(variance[0]), V{}) * closed_r(d, cos_half, c[0]) * c[1];
            for (int k = 0; k < CHANNELS; k++) total[k] += lobe;
        }
        if (D_TT) {
            closed_tt(d, sin_half, cos_half, c, tt);
            V lobe = gauss(d.theta_h - alpha[1], all(variance[1]), V{}) * c[1];
            for (int k = 0; k < CHANNELS; k++) total[k] += lobe * tt[k];
        }
        if (D_TRT) {
            V lobe = gauss(d.theta_h - alpha[2], all(variance[2]), V{}) * c[1];
            for (int k = 0; k < CHANNELS; k++) total[k] += lobe * record[O_TRT + k];
        }
        if (D_BACK)
            for (int k = 0; k < CHANNELS; k++)
                total[k] += in_back(d, c[2] * a_b[k] * gauss(d.theta_h - delta[k], sigma2[k], V{}));
        for (int k = 0; k < CHANNELS; k++) total[k] *= v;
    }
    if (S_ANY) {
        V unlit = 1.0f - v, over_n{};
#if POISSON
        over_n = inverse(mean_exponential(n));
#endif
        for (int k = 0; k < CHANNELS; k++) {
            V passed, events, sum{};
            forward(log_a[k], n, over_n, &passed, &events);
            passed += c[3];
            V wide = events * beta2[k];
            if (S_R) sum += gauss(d.theta_h - alpha[0], variance[0] + wide, passed) * record[O_R_SCATTERED];
            if (S_TT) sum += gauss(d.theta_h - alpha[1], variance[1] + wide, passed) * record[O_TT_SCATTERED + k];
            if (S_TRT) sum += gauss(d.theta_h - alpha[2], variance[2] + wide, passed) * record[O_TRT_SCATTERED + k];
            sum *= c[1];
            if (S_BACK)
                sum += in_back(d, c[4] * c[2] * a_b[k] * gauss(d.theta_h - delta[k], sigma2[k] + wide, passed));
            total[k] += unlit * sum;
        }
    }
    V factor = d.cos_i / (d.cos_diff * d.cos_diff);
    for (int k = 0; k < CHANNELS; k++) total[k] *= factor;
}

enum { MODE, BELOW, ABOVE, LOG_SCALE, EDGE, LEFT, FAR_LEFT, NEAR_LEFT, FAR_RIGHT, NEAR_RIGHT };

template <bool SINGLE> INLINE V density(const Context& c, int64_t b, const Direction& d, const V* record) {
    V total{};
    for (int k = 0; k < K; k++) {
        V x = d.theta_h - field<SINGLE>(c, MODE, k, b);
        V z = x * (x < 0.0f ? field<SINGLE>(c, BELOW, k, b) : field<SINGLE>(c, ABOVE, k, b));
        V lobe = expo(field<SINGLE>(c, LOG_SCALE, k, b) - z * z);
        if (LAW[k] >= 0) lobe *= record[LAW[k]];
        else if (LAW[k] == -1) lobe *= 0.318309886f;
        else lobe = d.phi < 1.57079633f ? lobe * 0.636619772f : V{};
        total += lobe;
    }
    return total / d.cos_i + c.sphere;
}

INLINE V azimuth(const Tables& t, I law, V diff, V rest, V target) {
    V x = vmin(diff * ((LAW_ROWS - 1) / 1.57079633f), all(LAW_ROWS - 1));
    I row = imin(whole(x), I{} + (LAW_ROWS - 2));
    row = rest < x - number(row) ? row + 1 : row;
    I number_of_row = law * LAW_ROWS + row;
    I first = number_of_row * LAW_COLUMNS;
    // the guide brackets the column; what is left is bisected
    I pair = take_pairs(t.guide, number_of_row * (GUIDE + 1) + imin(whole(target * GUIDE), I{} + (GUIDE - 1)));
    I low = pair & 0xffff, high = ((pair >> 16) & 0xffff) + 1;
    while (any(high - low > 1)) {
        I middle = (low + high) >> 1;
        I below = take(t.cumulative, first + middle) <= target;
        low = below ? middle : low;
        high = below ? high : middle;
    }
    const float width = 3.14159265f / (LAW_COLUMNS - 1);
    I here = first + low;
    V f0 = take(t.density, here), f1 = take(t.density, here + 1);
    V missing = vmax(target - take(t.cumulative, here), V{}) * (1.0f / width);
    V slope = root(vmax(f0 * f0 + 2.0f * (f1 - f0) * missing, all(1e-30f)));
    V inside = vmin(2.0f * missing / (f0 + slope), all(1.0f));
    return vmin((number(low) + inside) * width, all(3.14159265f));
}

// Uniforms of sixteen neighbours, one coordinate per row
INLINE void uniforms(const float* u, V* us) {
    V triples[3] = {load(u), load(u + W), load(u + 2 * W)};
    for (int k = 0; k < 3; k++) us[k] = third(triples, k);
}

template <bool SINGLE> INLINE void draw(const Tables& t, const Context& c, int64_t b, V* us, V* theta_i, V* phi) {
    const float eps = 2.98023224e-8f;
    for (int k = 0; k < 3; k++) us[k] = vmin(vmax(us[k], all(eps)), all(1.0f - 5.96046448e-8f));
    static const int wanted[8] = {MODE, BELOW, ABOVE, LEFT, FAR_LEFT, NEAR_LEFT, FAR_RIGHT, NEAR_RIGHT};
    V chosen[8], low{}, high = field<SINGLE>(c, EDGE, 0, b);
    for (int f = 0; f < 8; f++) chosen[f] = field<SINGLE>(c, wanted[f], 0, b);
    I law = I{} + LAW[0];
    for (int k = 1; k < K; k++) {
        V edge = field<SINGLE>(c, EDGE, k - 1, b);
        I beyond = us[0] >= edge;
        for (int f = 0; f < 8; f++) chosen[f] = beyond ? field<SINGLE>(c, wanted[f], k, b) : chosen[f];
        law = beyond ? I{} + LAW[k] : law;
        low = beyond ? edge : low;
        high = beyond ? field<SINGLE>(c, EDGE, k, b) : high;
    }
    I outside = us[0] >= field<SINGLE>(c, EDGE, K - 1, b);
    V rest = (us[0] - low) / vmax(high - low, all(1e-30f));
    V left = chosen[3];
    I below = us[1] < left;
    V share = below ? us[1] / vmax(left, all(1e-30f)) : (1.0f - us[1]) / vmax(1.0f - left, all(1e-30f));
    share = vmin(vmax(share, all(eps)), all(1.0f));
    V far = below ? chosen[4] : chosen[6], near = below ? chosen[5] : chosen[7];
    V scale = 0.707106781f / (below ? -chosen[1] : chosen[2]);
    V theta_h = chosen[0] + scale * upper_quantile(far + share * (near - far));
    V theta_r = of<SINGLE>(c.theta_r, b);
    V lobe = vmin(vmax(2.0f * theta_h - theta_r, all(-1.57079637f)), all(1.57079637f));
    *theta_i = outside ? arcsine(2.0f * us[1] - 1.0f) : lobe;
    V sign = 2.0f * us[2] - 1.0f, target = magnitude(sign), even = target * 3.14159265f;
    V drawn = law < -1 ? even * 0.5f : even;
#if LAW_TABLES
    V table = azimuth(t, law < 0 ? I{} : law, magnitude(theta_r - *theta_i) * 0.5f, rest, target);
    drawn = law >= 0 ? table : drawn;
#endif
    *phi = signed_like(outside ? even : drawn, sign);
}

// Calls `body(context, direction)` for blocks of sixteen, all samples of a block of contexts in turn; the last block
// overlaps the one before.
template <typename F> INLINE void blocks(int64_t samples, int64_t batch, F body) {
    for (int64_t b = 0; b < batch; b += W) {
        int64_t start = b + W > batch ? batch - W : b;
        for (int64_t s = 0; s < samples; s++) body(start, s * batch + start);
    }
}

template <bool SINGLE>
static void run_eval(const Tables& t, const Context& c, int64_t s, int64_t b, const float* theta, const float* phi,
                     float* out) {
    blocks(s, b, [&](int64_t k, int64_t i) {
        Direction d = at(load(theta + i), load(phi + i), of<SINGLE>(c.theta_r, k));
        V record[WIDTH], value[CHANNELS];
        if (TABULATED) look_up(t, d, record);
        evaluate(t, d, record, of<SINGLE>(c.n, k), of<SINGLE>(c.v, k), value);
        for (int q = 0; q < CHANNELS; q++) store(out + q * s * b + i, value[q]);
    });
}

template <bool SINGLE>
static void run_log_prob(const Tables& t, const Context& c, int64_t s, int64_t b, const float* theta, const float* phi,
                         float* out) {
    blocks(s, b, [&](int64_t k, int64_t i) {
        Direction d = at(load(theta + i), load(phi + i), of<SINGLE>(c.theta_r, k));
        V record[WIDTH];
        if (LAW_TABLES) look_up(t, d, record);
        store(out + i, logarithm(vmax(density<SINGLE>(c, k, d, record), all(1.17549435e-38f))));
    });
}

template <bool SINGLE>
static void run_sample(const Tables& t, const Context& c, int64_t s, int64_t b, const float* u, float* theta,
                       float* phi) {
    blocks(s, b, [&](int64_t k, int64_t i) {
        V x, y, us[3];
        uniforms(u + 3 * i, us);
        draw<SINGLE>(t, c, k, us, &x, &y);
        store(theta + i, x);
        store(phi + i, y);
    });
}

template <bool SINGLE>
static void run_sample_eval(const Tables& t, const Context& c, int64_t s, int64_t b, const float* u, float* theta,
                            float* phi, float* pdf, float* out) {
    blocks(s, b, [&](int64_t k, int64_t i) {
        V x, y, us[3], record[WIDTH], value[CHANNELS];
        uniforms(u + 3 * i, us);
        draw<SINGLE>(t, c, k, us, &x, &y);
        store(theta + i, x);
        store(phi + i, y);
        Direction d = at(x, y, of<SINGLE>(c.theta_r, k));
        look_up(t, d, record);
        store(pdf + i, density<SINGLE>(c, k, d, record));
        evaluate(t, d, record, of<SINGLE>(c.n, k), of<SINGLE>(c.v, k), value);
        for (int q = 0; q < CHANNELS; q++) store(out + q * s * b + i, value[q]);
    });
}

extern "C" {
void dsfit_eval(const Tables* t, const Context* c, int64_t s, int64_t b, const float* theta, const float* phi,
                float* out) {
    c->count == 1 ? run_eval<true>(*t, *c, s, b, theta, phi, out) : run_eval<false>(*t, *c, s, b, theta, phi, out);
}
void dsfit_log_prob(const Tables* t, const Context* c, int64_t s, int64_t b, const float* theta, const float* phi,
                    float* out) {
    c->count == 1 ? run_log_prob<true>(*t, *c, s, b, theta, phi, out)
                  : run_log_prob<false>(*t, *c, s, b, theta, phi, out);
}
void dsfit_sample(const Tables* t, const Context* c, int64_t s, int64_t b, const float* u, float* theta, float* phi) {
    c->count == 1 ? run_sample<true>(*t, *c, s, b, u, theta, phi) : run_sample<false>(*t, *c, s, b, u, theta, phi);
}
void dsfit_sample_eval(const Tables* t, const Context* c, int64_t s, int64_t b, const float* u, float* theta,
                       float* phi, float* pdf, float* out) {
    c->count == 1 ? run_sample_eval<true>(*t, *c, s, b, u, theta, phi, pdf, out)
                  : run_sample_eval<false>(*t, *c, s, b, u, theta, phi, pdf, out);
}
}
