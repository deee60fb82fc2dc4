// Local frame: x along the fibre's tangent, from root to tip; y and z span the normal plane, turned about x at will, as
// the fibre is round. wo (to the viewer) and wi (to the light) are unit vectors that point away from the fibre.
// Inclination theta = asin(x), azimuth atan2(z, y); phi = phi_r - phi_i. Angles are radians.
//
// f is the integrand's factor F cos(theta_i), theta_i measured from the normal plane: the integral of f L over all
// directions wi is the outgoing radiance, without another cosine. Densities are per steradian.
//
// PBRT: its hair frame is this one (x along dp/du, theta = asin(x), phi = atan2(z, y)), so vectors of its shading frame
// are passed on as they are where curves run from root to tip; where they run from tip to root, negate x of both. PBRT
// multiplies what BxDF::f returns by |wi.z|, z being the surface normal: return f_pbrt = F cos(theta_i) / |wi.z|.
// (dsfit.Material does the same; its tangent, normal and binormal are PBRT's x, z and -y.)
//
// n >= 0 is the number of fibres that scatter the light forward before it arrives, v in [0, 1] the directly lit share.
// A Context is prepared once per shading point and shared by its directions; n and v in it shape the density, and are
// what f uses unless others are given. All functions may be called from any thread: there is no state. Numbers that are
// not finite are not looked for. Any optimisation level and -ffast-math keep the results to some 1e-5.
#ifndef @GUARD@
#define @GUARD@

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

// Names differ between headers of different content, so that programs and plugins may hold several.
namespace @NAMESPACE@ {
inline namespace @CONTENT@ {

inline constexpr int channels = @CHANNELS@;
using Color = std::array<float, channels>;
using Vector = std::array<float, 3>;
using Uniforms = std::array<float, 3>;

// A drawn direction, its density per steradian, and F cos(theta_i) there.
struct Sample {
    Vector wi;
    float pdf;
    Color f;
};

// The same by inclination and relative azimuth phi = phi_r - phi_i.
struct AngleSample {
    float theta_i, phi, pdf;
    Color f;
};

namespace detail {

@TABLES@

inline constexpr double half_pi = 1.5707963267948966, two_pi = 6.2831853071795865;
inline constexpr float tiny_cosine = 1.42108547e-14f, nothing = -1e30f, root_half = 0.707106781f;

inline float between(float a, float b, float t) { return a + (b - a) * t; }
inline float square(float x) { return x * x; }

// A cell of equidistant nodes, and the position inside it, in [0, 1].
struct Cell {
    int first;
    float share;
    double exact;
};

inline Cell cell(double position, int nodes) {
    const double x = std::min(std::max(position, 0.0), static_cast<double>(nodes - 1));
    const int first = std::min(static_cast<int>(x), nodes - 2);
    return {first, static_cast<float>(x - first), x - first};
}

// A direction relative to the viewer: |theta_diff| and |phi|, and cosines that are never 0. What cancels is computed
// in double.
struct Direction {
    float theta_i, theta_h, diff, phi, cos_i, cos_diff;
};

inline Direction direction(float theta_r, float theta_i, float cos_i, float phi) {
    const double r = theta_r, i = theta_i, turned = phi;
    const double diff = 0.5 * std::abs(r - i);
    const double wrapped = std::abs(turned - two_pi * std::floor(turned / two_pi + 0.5));
    Direction d{};
    d.theta_i = theta_i;
    d.theta_h = static_cast<float>(0.5 * (r + i));
    d.diff = static_cast<float>(diff);
    d.phi = static_cast<float>(wrapped);
    d.cos_i = std::max(cos_i, tiny_cosine);
    d.cos_diff = std::max(std::sin(static_cast<float>(half_pi - diff)), tiny_cosine);
    return d;
}

// ---- The BSDF -------------------------------------------------------------------------------------------------

// exp(log_scale) times the normal density
inline float gauss(float x, float square_width, float log_scale) {
    return std::exp(log_scale - 0.5f * x * x / square_width) * 0.398942280f / std::sqrt(square_width);
}

// 1 - F of a dielectric, without cancellation at grazing: 4 x y / (x + y)^2 for both polarisations
inline float transmitted(float cosine) {
    const float g = std::sqrt((eta - 1.0f) * (eta + 1.0f) + cosine * cosine), p = eta * eta * cosine;
    return 2.0f * g * (cosine / square(cosine + g) + p / square(p + g));
}

// N_R: the ray that is reflected leaves by gamma = |phi| / 2
inline float azimuth_r(const Direction& d, float cos_half) {
    return (1.0f - transmitted(d.cos_diff * cos_half)) * cos_half * 0.25f;
}

// N_TT in closed form, with kappa = 1 / eta'
inline Color azimuth_tt(const Direction& d, float sin_half, float cos_half) {
    const float inverse_eta = 1.0f / std::sqrt((eta - 1.0f) * (eta + 1.0f) + square(d.cos_diff));
    const float kappa = d.cos_diff * inverse_eta, gap = sin_half - kappa;
    const float scale = 1.0f / std::sqrt(gap * gap + cos_half * cos_half);
    const float cos_gamma = std::min(std::max(gap * scale, 0.0f), 1.0f), inner = kappa * cos_half * scale;
    const float cos_t = std::sqrt(std::max((1.0f - inner) * (1.0f + inner), 0.0f));
    const float widened = cos_gamma * cos_t * (kappa * cos_gamma + cos_t) / ((1.0f - kappa) * (1.0f + kappa));
    const float common = 0.25f * square(transmitted(d.cos_diff * cos_gamma)) * widened;
    Color value{};
    for (int c = 0; c < channels; c++) value[c] = common * std::exp(-2.0f * eta * cos_t * inverse_eta * sigma_a[c]);
    return value;
}

// N_TRT from its table
inline Color azimuth_trt(const Direction& d) {
    const Cell row = cell(d.diff * ((value_rows - 1) / half_pi), value_rows);
    const Cell column = cell(d.phi * (2 * (columns - 1) / two_pi), columns);
    Color value{};
    for (int c = 0; c < channels; c++) {
        float rows[2];
        for (int k = 0; k < 2; k++) {
            const std::uint16_t* q = trt + ((row.first + k) * columns + column.first) * channels + c;
            rows[k] = between(q[0], q[channels], column.share) * trt_scale[(row.first + k) * channels + c];
        }
        value[c] = between(rows[0], rows[1], row.share);
    }
    return value;
}

// N^G_R, then N^G_TT and N^G_TRT by channel. N^G(phi) + N^G(pi - phi) is the same for all phi, so that the table ends
// at pi/2.
inline constexpr int spread_width = 1 + 2 * channels;

inline std::array<float, spread_width> azimuths_scattered(const Direction& d) {
    const Cell row = cell(d.diff * ((value_rows - 1) / half_pi), value_rows);
    const bool front = d.phi > static_cast<float>(half_pi);
    const double folded = front ? half_pi - (d.phi - half_pi) : static_cast<double>(d.phi);
    const Cell column = cell(folded * ((spread_columns - 1) / half_pi), spread_columns);
    std::array<float, spread_width> value{};
    for (int c = 0; c < spread_width; c++) {
        float rows[2];
        for (int k = 0; k < 2; k++) {
            const std::uint16_t* start = spread + (row.first + k) * spread_columns * spread_width + c;
            const std::uint16_t* q = start + column.first * spread_width;
            const float found = between(q[0], q[spread_width], column.share);
            const float middle = start[(spread_columns - 1) * spread_width];
            rows[k] = (front ? 2.0f * middle - found : found) * spread_scale[(row.first + k) * spread_width + c];
        }
        value[c] = between(rows[0], rows[1], row.share);
    }
    return value;
}

// log a_f, beta_f^2, A_b, Delta_b, sigma_b^2 by channel; knots are uniform in sign(theta) (1 - sqrt(1 - 2|theta|/pi))
using Averages = std::array<float, 5 * channels>;

inline Averages averages(float theta_i) {
    const double gap = std::sqrt(std::max(1.0 - std::abs(static_cast<double>(theta_i)) / half_pi, 0.0));
    const double y = theta_i < 0.0f ? gap : 2.0 - gap;
    const Cell knot = cell(y * (0.5 * (knots - 1)), knots);
    const float* low = average_table + knot.first * 5 * channels;
    Averages value{};
    for (int c = 0; c < 5 * channels; c++) value[c] = between(low[c], low[5 * channels + c], knot.share);
    return value;
}

inline bool back_leaves(const Direction& d) { return !half_back || d.phi < static_cast<float>(half_pi); }

// F_direct / c_M cos^2(theta_diff): sum of M_p N_p and back scattering
inline Color direct(const Direction& d, const Averages& a) {
    const float sin_half = std::sin(0.5f * d.phi), cos_half = std::max(std::cos(0.5f * d.phi), 0.0f);
    const Color tt = azimuth_tt(d, sin_half, cos_half), third = azimuth_trt(d);
    float lobe[3];
    for (int p = 0; p < 3; p++) lobe[p] = gauss(d.theta_h - alpha[p], variance[p], 0.0f);
    const float first = lobe[0] * azimuth_r(d, cos_half);
    Color value{};
    for (int c = 0; c < channels; c++) {
        value[c] = first + lobe[1] * tt[c] + lobe[2] * third[c];
        if (back_factor > 0.0f && back_leaves(d)) {
            const float x = d.theta_h - a[3 * channels + c];
            value[c] += back_factor * a[2 * channels + c] * gauss(x, a[4 * channels + c], 0.0f);
        }
    }
    return value;
}

// Logarithm of what n fibres pass on, each exp(log_a), and how many times they widen the light: n fibres exactly, or
// n on average (at least one), where `poisson` says so
struct Passed {
    float log_share, events;
};

inline float mean_exponential(float x) { return x > 0.0f ? -std::expm1(-x) / x : 1.0f; }

inline Passed passed_on(float log_a, float n) {
    if constexpr (poisson) {
        const float mean = mean_exponential(n * std::exp(log_a));
        return {log_a + n * std::expm1(log_a) + std::log(mean / mean_exponential(n)), 1.0f / mean};
    } else {
        return {n * log_a, n};
    }
}

// F_scatter / c_M cos^2(theta_diff): the transmittance joins the exponents, so that nothing overflows
inline Color scattered(const Direction& d, const Averages& a, float n) {
    const auto azimuths = azimuths_scattered(d);
    Color value{};
    for (int c = 0; c < channels; c++) {
        const Passed forward = passed_on(a[c], n);
        const float passed = log_density + forward.log_share, wide = forward.events * a[channels + c];
        float sum = gauss(d.theta_h - alpha[0], variance[0] + wide, passed) * azimuths[0];
        sum += gauss(d.theta_h - alpha[1], variance[1] + wide, passed) * azimuths[1 + c];
        sum += gauss(d.theta_h - alpha[2], variance[2] + wide, passed) * azimuths[1 + channels + c];
        if (back_factor > 0.0f && back_leaves(d)) {
            const float x = d.theta_h - a[3 * channels + c];
            sum += scattered_back * back_factor * a[2 * channels + c] * gauss(x, a[4 * channels + c] + wide, passed);
        }
        value[c] = sum;
    }
    return value;
}

// F cos(theta_i) = (v F_direct + (1 - v) F_scatter) cos(theta_i)
inline Color evaluate(const Direction& d, float n, float v) {
    const Averages a = averages(d.theta_i);
    Color total{};
    if (v > 0.0f) {
        const Color value = direct(d, a);
        for (int c = 0; c < channels; c++) total[c] += v * value[c];
    }
    if (v < 1.0f) {
        const Color value = scattered(d, a, n);
        for (int c = 0; c < channels; c++) total[c] += (1.0f - v) * value[c];
    }
    const float factor = lobe_constant * d.cos_i / square(d.cos_diff);
    for (float& x : total) x *= factor;
    return total;
}

// ---- The mixture of a context ---------------------------------------------------------------------------------

// One lobe: a two-piece normal law of theta_h, and a law of azimuth given theta_diff
struct Component {
    float mode, below, above;  // below, above: sqrt(1/2) over the width on either side of the mode
    float log_scale;           // log of weight times Jacobians over the mass of both pieces under the peak
    float edge;                // sum of the weights up to and including this component
    float left;                // share of the piece below the mode
    float far_left, near_left, far_right, near_right;  // twice the upper tail of the normal law at each end
    int law;                   // number of a table, or one of these:
};
inline constexpr int all_around = -1, back_half = -2;

// Of all lobes of one kind. Energies differ by far less than they are, so they are double.
template <int N> struct Moments {
    std::array<double, N> energy;  // logarithms
    std::array<float, N> mode, below, above;  // of theta_h; logarithms of the widths

    std::array<float, N>& shape(int kind) { return kind == 0 ? mode : kind == 1 ? below : above; }
};

inline Moments<near_lobes> near_moments(Cell row) {
    Moments<near_lobes> m{};
    const float *p = near_table + row.first * 4 * near_lobes, *q = p + 4 * near_lobes;
    for (int k = 0; k < near_lobes; k++) {
        m.energy[k] = between(p[k], q[k], row.share);
        for (int f = 0; f < 3; f++) {
            const int i = (f + 1) * near_lobes + k;
            m.shape(f)[k] = between(p[i], q[i], row.share);
        }
    }
    return m;
}

inline Moments<far_lobes> far_moments(Cell row, float n) {
    int level = 0;
    while (level < levels - 2 && n >= depths[level + 1]) level++;
    const double along = (static_cast<double>(n) - depths[level]) / (depths[level + 1] - depths[level]);
    const float inside = static_cast<float>(std::min(along, 1.0));
    const int first = row.first * levels + level, next = first + levels;
    Moments<far_lobes> m{};
    for (int k = 0; k < far_lobes; k++) {
        const float *p = far_energy + first * far_lobes + k, *q = far_energy + next * far_lobes + k;
        const double shallow = p[0] + row.exact * (static_cast<double>(q[0]) - p[0]);
        const double deep = p[far_lobes] + row.exact * (static_cast<double>(q[far_lobes]) - p[far_lobes]);
        m.energy[k] = shallow + along * (deep - shallow);  // goes on beyond the last depth
        for (int f = 0; f < 3; f++) {
            const std::uint16_t* low = far_shape + (first * 3 + f) * far_lobes + k;
            const std::uint16_t* high = far_shape + (next * 3 + f) * far_lobes + k;
            const float above = between(low[0], high[0], row.share);
            const float below = between(low[3 * far_lobes], high[3 * far_lobes], row.share);
            m.shape(f)[k] = shape_start[f] + shape_step[f] * between(above, below, inside);
        }
    }
    return m;
}

template <typename Numbers> inline double log_sum(const Numbers& x) {
    const double top = *std::max_element(x.begin(), x.end());
    float sum = 0.0f;
    for (double y : x) sum += std::exp(static_cast<float>(y - top));
    return top + std::log(sum);
}

inline float log_share(float share) { return share > 0.0f ? std::log(share) : nothing; }
inline float soft(float x) { return x / std::sqrt(1.0f + x * x); }
inline float bounded(float x, float bound) { return bound * soft(x / bound); }
inline float limited_ratio(double x) { return soft(static_cast<float>(std::min(std::max(x, -100.0), 100.0)) / 3.0f); }

using Activations = std::array<float, widest>;

// What the network sees of a context
inline Activations features(float theta_r, float n, float v, const Moments<near_lobes>& near,
                            const Moments<far_lobes>& far) {
    const float sine = std::sin(theta_r), cosine = std::max(std::cos(theta_r), 0.0f);
    const std::array<double, 3> reflected = {far.energy[0], far.energy[3], far.energy[4]};
    Activations x{};
    x[0] = theta_r * 0.636619772f;
    x[1] = 2.0f * sine * cosine;
    x[2] = cosine;
    x[3] = theta_r / (cosine + 0.15f) / 5.0f;
    x[4] = std::log1p(n) / 3.0f;
    x[5] = n / (n + 4.0f);
    x[6] = far.below[1] + 1.0f;
    x[7] = v;
    x[8] = limited_ratio(log_sum(near.energy) - log_sum(far.energy) + log_share(v) - log_share(1.0f - v));
    x[9] = limited_ratio(far.energy[1] - log_sum(reflected));
    return x;
}

// Fully connected layers; each is its biases and then its weights [inputs][outputs]. The last outputs are corrections
// of modes, widths below, widths above and log weights, `components` of each.
template <int L> inline void layer(const float* p, Activations& x) {
    constexpr int inputs = sizes[L], outputs = sizes[L + 1];
    std::array<float, outputs> y{};
    for (int o = 0; o < outputs; o++) y[o] = p[o];
    for (int i = 0; i < inputs; i++) {
        const float value = L ? soft(x[i]) : x[i];
        for (int o = 0; o < outputs; o++) y[o] += value * p[(i + 1) * outputs + o];
    }
    std::copy(y.begin(), y.end(), x.begin());
    if constexpr (L + 1 < layers) layer<L + 1>(p + outputs * (inputs + 1), x);
}

// The width of a piece whose mode lies `distance` outside what can be reached
inline float limited_width(float width, float distance) {
    return distance > 4.0f * width ? 4.0f * width * width / distance : width;
}

// The two pieces of one component on [low, high], the reachable theta_h. A mode far outside is moved to 4 widths, with
// the width that keeps the slope at the border.
inline Component component(float mode, float below, float above, float log_weight, float theta_r) {
    const float low = 0.5f * theta_r - 0.785398163f, high = 0.5f * theta_r + 0.785398163f;
    const float split = std::min(std::max(mode, low), high);
    const float over = std::max(mode - split, 0.0f), under = std::max(split - mode, 0.0f);
    below = limited_width(below, over);
    above = limited_width(above, under);
    const float past = std::min(over, 4.0f * below), before = std::min(under, 4.0f * above);
    Component c{};
    c.mode = split + past - before;
    c.below = root_half / below;
    c.above = root_half / above;
    c.near_left = std::erfc(past * c.below);
    c.far_left = std::erfc((split - low + past) * c.below);
    c.near_right = std::erfc(before * c.above);
    c.far_right = std::erfc((high - split + before) * c.above);
    const float left = split > low ? below * (c.near_left - c.far_left) : 0.0f;
    const float right = split < high ? above * (c.near_right - c.far_right) : 0.0f;
    c.left = left / (left + right);
    c.log_scale = log_weight - std::log(5.01325655f * (left + right));
    return c;
}

}  // namespace detail

// What depends on the shading point alone; prepared once, shared by all of its directions. The view may also be given
// by angles; then phi_r is 0.
struct Context {
    float theta_r, n, v;
    float cos_phi_r, sin_phi_r;
    std::array<detail::Component, detail::components> mixture;
    int count;  // components of this context
};

// n >= 0 scattering fibres towards the light (a real number), v in [0, 1] the directly lit share. These are hints:
// they shape the density, and f uses them too.
inline Context prepare(float theta_r, float n, float v) {
    using namespace detail;
    Context context{};
    context.theta_r = theta_r = std::min(std::max(theta_r, -1.57079637f), 1.57079637f);
    context.n = n = std::max(n, 0.0f);
    context.v = v = std::min(std::max(v, 0.0f), 1.0f);
    context.cos_phi_r = 1.0f;
    const Cell row = cell((theta_r / half_pi + 1.0) * (0.5 * (moment_rows - 1)), moment_rows);
    Moments<near_lobes> near = near_moments(row);
    Moments<far_lobes> far = far_moments(row, n);
    Activations x = features(theta_r, n, v, near, far);
    layer<0>(network, x);

    // the lobes' shares of the light; back scattering of both kinds is one lobe
    constexpr int lobes = components - 1, last_near = near_lobes - 1, last_far = far_lobes - 1;
    Moments<lobes> m{};
    const double lit = log_share(v), unlit = log_share(1.0f - v);
    for (int k = 0; k < 3; k++) m.energy[k] = near.energy[k] + lit;
    for (int k = 0; k < 5; k++) m.energy[3 + k] = far.energy[k] + unlit;
    for (int f = 0; f < 3; f++) {
        for (int k = 0; k < 3; k++) m.shape(f)[k] = near.shape(f)[k];
        for (int k = 0; k < 5; k++) m.shape(f)[3 + k] = far.shape(f)[k];
    }
    if constexpr (near_lobes > 3) {
        const double a = near.energy[last_near] + lit, b = far.energy[last_far] + unlit;
        const float ratio = std::exp(-static_cast<float>(std::abs(a - b)));
        m.energy[lobes - 1] = std::max(a, b) + std::log1p(ratio);
        const float share = (a < b ? ratio : 1.0f) / (1.0f + ratio);
        for (int f = 0; f < 3; f++)
            m.shape(f)[lobes - 1] = between(far.shape(f)[last_far], near.shape(f)[last_near], share);
    }

    std::array<float, components> log_weight{};
    const double total = log_sum(m.energy);
    for (int k = 0; k < lobes; k++) log_weight[k] = static_cast<float>(m.energy[k] - total) + x[3 * components + k];
    log_weight[lobes] = broad_log_energy + x[3 * components + lobes];
    const float whole = static_cast<float>(log_sum(log_weight)) - log_lobes;
    float edge = 0.0f;
    for (int k = 0; k < components; k++) {
        const float weight = std::exp(log_weight[k] - whole);
        if (!(weight > 0.0f)) continue;
        const float mean = k < lobes ? m.mode[k] : 0.0f;
        const float below = k < lobes ? m.below[k] : broad_log_width, above = k < lobes ? m.above[k] : broad_log_width;
        const float mode = mean + std::exp(0.5f * (below + above)) * bounded(x[k], 4.0f);
        const float s0 = std::exp(below + bounded(x[components + k], 3.0f));
        const float s1 = std::exp(above + bounded(x[2 * components + k], 3.0f));
        Component c = component(mode, std::min(std::max(s0, least_width), most_width),
                                std::min(std::max(s1, least_width), most_width), log_weight[k] - whole, theta_r);
        c.edge = edge += weight;
        c.law = laws[k];
        context.mixture[context.count++] = c;
    }
    return context;
}

namespace detail {

// ---- Density and draws ----------------------------------------------------------------------------------------

// Density of |phi| given theta_diff, which lies between `row` and the next: linear between columns and between rows
inline float law_density(int law, Cell row, const Direction& d) {
    const int nodes = law_columns[law];
    const Cell column = cell(d.phi * (2 * (nodes - 1) / two_pi), nodes);
    const std::uint16_t* q = law_table + law_start[law] + row.first * nodes + column.first;
    const float* scale = law_scale + law * law_rows + row.first;
    const float low = between(q[0], q[1], column.share), high = between(q[nodes], q[nodes + 1], column.share);
    return between(low * scale[0], high * scale[1], row.share);
}

inline float density(const Context& context, const Direction& d) {
    const Cell row = cell(d.diff * ((law_rows - 1) / half_pi), law_rows);
    float known[law_count];
    for (float& x : known) x = -1.0f;
    float total = 0.0f;
    for (int k = 0; k < context.count; k++) {
        const Component& c = context.mixture[k];
        const float x = d.theta_h - c.mode, z = x * (x < 0.0f ? c.below : c.above);
        float lobe = std::exp(c.log_scale - z * z);
        if (c.law == all_around) {
            lobe *= 0.318309886f;
        } else if (c.law == back_half) {
            lobe *= d.phi < static_cast<float>(half_pi) ? 0.636619772f : 0.0f;
        } else {
            float& azimuth = known[c.law];
            if (azimuth < 0.0f) azimuth = law_density(c.law, row, d);
            lobe *= azimuth;
        }
        total += lobe;
    }
    return total / d.cos_i + sphere;
}

// x >= 0 whose upper tail of the normal law is y / 2, y in (0, 1]: two polynomials in -log(y (2 - y)), Giles (2010)
inline float upper_quantile(float y) {
    const float w = -std::log(std::max(y * (2.0f - y), 1e-14f));
    if (w < 6.25f) {
        constexpr float body[10] = {-7.155819616e-09f, 1.88914308e-07f,  -1.591124583e-06f, -6.607918076e-07f,
                                    8.208768495e-05f,  -0.0002139362175f, -0.003268174582f, 0.01631625781f,
                                    0.3281200195f,     1.253314044f};
        float p = 0.0f;
        for (float c : body) p = p * w + c;
        return p * (1.0f - y);
    }
    constexpr float tail[8] = {-7.316103615e-05f, 0.0004535794612f, -0.001169801392f, 0.00237360244f,
                               -0.004273630661f,  0.003671877968f,  2.28473466f,      5.573054694f};
    const float t = (std::sqrt(w) - 4.1f) / 1.6f;
    float p = 0.0f;
    for (float c : tail) p = p * t + c;
    return p;
}

// |phi| from one of the two rows around theta_diff; `rest`, uniform, chooses it with the probability of the blend. The
// row's CDF is a sum of integers: in steps of `stride` columns from a table, then column by column.
inline float draw_azimuth(int law, float diff, float rest, float target) {
    const Cell cells = cell(diff * ((law_rows - 1) / half_pi), law_rows);
    const int row = cells.first + (rest < cells.share ? 1 : 0), nodes = law_columns[law];
    const int steps = (nodes - 2) / stride + 1;
    const std::uint16_t* q = law_table + law_start[law] + row * nodes;
    const std::uint32_t* sums = law_sums + sums_start[law] + row * steps;
    const double wanted = static_cast<double>(target) * sums[steps - 1];
    int step = 0;
    while (step < steps - 1 && sums[step] <= wanted) step++;
    int j = step * stride;
    std::uint32_t before = step ? sums[step - 1] : 0;
    while (j < nodes - 2 && before + q[j] + q[j + 1] <= wanted) {
        before += static_cast<std::uint32_t>(q[j]) + q[j + 1];
        j++;
    }
    // the area below x in this column is 2 q0 x + (q1 - q0) x^2
    const float q0 = q[j], q1 = q[j + 1], missing = static_cast<float>(wanted - before);
    const float root = std::sqrt(std::max(q0 * q0 + (q1 - q0) * missing, 1e-20f));
    const float x = std::min(std::max(missing / (q0 + root), 0.0f), 1.0f);
    return static_cast<float>((j + static_cast<double>(x)) * (0.5 * two_pi / (nodes - 1)));
}

struct Drawn {
    float theta_i, phi;
};

// u[0] selects the component (what is left of it a row of the table), u[1] is inverted in theta_h, u[2] in phi
inline Drawn draw(const Context& context, const Uniforms& u) {
    constexpr float eps = 2.98023224e-8f;
    const float u0 = std::min(std::max(u[0], eps), 1.0f - 5.96046448e-8f);
    const float u1 = std::min(std::max(u[1], eps), 1.0f - 5.96046448e-8f);
    const float u2 = std::min(std::max(u[2], eps), 1.0f - 5.96046448e-8f);
    const float sign = 2.0f * u2 - 1.0f, target = std::abs(sign), even = target * 3.14159265f;
    int k = 0;
    while (k < context.count && u0 >= context.mixture[k].edge) k++;
    if (k == context.count) {  // the uniform sphere
        const float s = 2.0f * u1 - 1.0f;
        return {std::atan2(s, 2.0f * std::sqrt(u1 * (1.0f - u1))), std::copysign(even, sign)};
    }
    const Component& c = context.mixture[k];
    const float low = k ? context.mixture[k - 1].edge : 0.0f;
    const float rest = (u0 - low) / std::max(c.edge - low, 1e-30f);
    // either piece is drawn from its far end, so that tails keep the digits of u
    const bool below = u1 < c.left;
    const float part = below ? u1 / std::max(c.left, 1e-30f) : (1.0f - u1) / std::max(1.0f - c.left, 1e-30f);
    const float share = std::min(std::max(part, eps), 1.0f);
    const float far = below ? c.far_left : c.far_right, near = below ? c.near_left : c.near_right;
    const float x = root_half * upper_quantile(far + share * (near - far));
    const float theta_h = below ? c.mode - x / c.below : c.mode + x / c.above;
    const float theta_i = std::min(std::max(2.0f * theta_h - context.theta_r, -1.57079637f), 1.57079637f);
    float phi = even;
    if (c.law == back_half) phi = 0.5f * even;
    if (c.law >= 0) phi = draw_azimuth(c.law, 0.5f * std::abs(context.theta_r - theta_i), rest, target);
    return {theta_i, std::copysign(phi, sign)};
}

inline Direction from_angles(const Context& context, float theta_i, float phi) {
    return direction(context.theta_r, theta_i, std::cos(theta_i), phi);
}

inline float inclination(const Vector& w) { return std::atan2(w[0], std::hypot(w[1], w[2])); }

// phi_r - phi_i of a direction in the frame; a direction along the fibre has azimuth 0
inline Direction from_vector(float theta_r, float cos_phi_r, float sin_phi_r, const Vector& wi) {
    const float radius = std::hypot(wi[1], wi[2]);
    const float y = radius > 0.0f ? wi[1] : 1.0f, z = radius > 0.0f ? wi[2] : 0.0f;
    const float phi = std::atan2(sin_phi_r * y - cos_phi_r * z, cos_phi_r * y + sin_phi_r * z);
    return direction(theta_r, std::atan2(wi[0], radius), radius, phi);
}

inline Direction from_vector(const Context& context, const Vector& wi) {
    return from_vector(context.theta_r, context.cos_phi_r, context.sin_phi_r, wi);
}

}  // namespace detail

// ---- By inclination and relative azimuth, radians --------------------------------------------------------------

// F cos(theta_i)
inline Color f(const Context& context, float theta_i, float phi) {
    return detail::evaluate(detail::from_angles(context, theta_i, phi), context.n, context.v);
}

// The same with n and v towards this light, which may differ from the context's hints.
inline Color f(const Context& context, float theta_i, float phi, float n, float v) {
    return detail::evaluate(detail::from_angles(context, theta_i, phi), n, v);
}

// Density per steradian.
inline float pdf(const Context& context, float theta_i, float phi) {
    return detail::density(context, detail::from_angles(context, theta_i, phi));
}

// A direction from three uniform numbers in [0, 1).
inline AngleSample sample_angles(const Context& context, const Uniforms& u) {
    const detail::Drawn drawn = detail::draw(context, u);
    const detail::Direction d = detail::from_angles(context, drawn.theta_i, drawn.phi);
    return {drawn.theta_i, drawn.phi, detail::density(context, d), detail::evaluate(d, context.n, context.v)};
}

// ---- By unit vectors of the local frame ------------------------------------------------------------------------

inline Context prepare(const Vector& wo, float n, float v) {
    Context context = prepare(detail::inclination(wo), n, v);
    const float radius = std::hypot(wo[1], wo[2]);
    if (radius > 0.0f) {
        context.cos_phi_r = wo[1] / radius;
        context.sin_phi_r = wo[2] / radius;
    }
    return context;
}

inline Color f(const Context& context, const Vector& wi) {
    return detail::evaluate(detail::from_vector(context, wi), context.n, context.v);
}

inline Color f(const Context& context, const Vector& wi, float n, float v) {
    return detail::evaluate(detail::from_vector(context, wi), n, v);
}

inline float pdf(const Context& context, const Vector& wi) {
    return detail::density(context, detail::from_vector(context, wi));
}

inline Sample sample(const Context& context, const Uniforms& u) {
    const AngleSample s = sample_angles(context, u);
    const float cosine = std::max(std::cos(s.theta_i), detail::tiny_cosine);
    const float a = std::cos(s.phi), b = std::sin(s.phi);
    const float y = context.cos_phi_r * a + context.sin_phi_r * b, z = context.sin_phi_r * a - context.cos_phi_r * b;
    return {{std::sin(s.theta_i), cosine * y, cosine * z}, s.pdf, s.f};
}

// What PBRT's BxDF::f returns: it is multiplied by |wi.z| later, PBRT's z being the surface normal. Unbounded where
// that is 0; the product is what matters.
inline Color f_pbrt(const Color& f_cos, const Vector& wi) {
    Color value = f_cos;
    for (float& x : value) x /= std::max(std::abs(wi[2]), 1e-19f);
    return value;
}

// ---- The same for a view that is met once ----------------------------------------------------------------------

inline Color f(const Vector& wo, const Vector& wi, float n, float v) {
    const float radius = std::hypot(wo[1], wo[2]);
    const float y = radius > 0.0f ? wo[1] / radius : 1.0f, z = radius > 0.0f ? wo[2] / radius : 0.0f;
    const detail::Direction d = detail::from_vector(std::atan2(wo[0], radius), y, z, wi);
    return detail::evaluate(d, std::max(n, 0.0f), std::min(std::max(v, 0.0f), 1.0f));
}

inline Sample sample(const Vector& wo, const Uniforms& u, float n, float v) { return sample(prepare(wo, n, v), u); }

inline float pdf(const Vector& wo, const Vector& wi, float n, float v) { return pdf(prepare(wo, n, v), wi); }

inline Color f_pbrt(const Vector& wo, const Vector& wi, float n, float v) { return f_pbrt(f(wo, wi, n, v), wi); }

// ---- What is known ---------------------------------------------------------------------------------------------

// Integrals of F cos(theta_i) over all directions, by quadrature of the exact BSDF in double precision.
struct Known {
    float theta_r, n, v;
    Color albedo;
};
@KNOWN@

}  // namespace @CONTENT@
}  // namespace @NAMESPACE@

#endif  // @GUARD@
