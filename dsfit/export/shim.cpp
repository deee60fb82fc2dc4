// The header's functions on arrays, for tests and timings. HEADER and NAMESPACE are put in when it is compiled.
#include HEADER

namespace h = NAMESPACE;

namespace {
h::Vector vector_at(const float* p, std::int64_t i) { return {p[3 * i], p[3 * i + 1], p[3 * i + 2]}; }
template <typename A> void put(float* p, std::int64_t i, const A& a) {
    std::copy(a.begin(), a.end(), p + i * static_cast<std::int64_t>(a.size()));
}
}  // namespace

extern "C" {
std::int64_t channel_count() { return h::channels; }
std::int64_t context_size() { return sizeof(h::Context); }

void prepare(const float* theta_r, const float* n, const float* v, std::int64_t count, h::Context* out) {
    for (std::int64_t b = 0; b < count; b++) out[b] = h::prepare(theta_r[b], n[b], v[b]);
}

// directions [samples, count] of contexts [count]
void eval(const h::Context* c, std::int64_t count, std::int64_t samples, const float* theta_i, const float* phi,
          float* out) {
    for (std::int64_t s = 0; s < samples; s++)
        for (std::int64_t b = 0, i = s * count; b < count; b++, i++) put(out, i, h::f(c[b], theta_i[i], phi[i]));
}

void pdf(const h::Context* c, std::int64_t count, std::int64_t samples, const float* theta_i, const float* phi,
         float* out) {
    for (std::int64_t s = 0; s < samples; s++)
        for (std::int64_t b = 0, i = s * count; b < count; b++, i++) out[i] = h::pdf(c[b], theta_i[i], phi[i]);
}

void sample(const h::Context* c, std::int64_t count, std::int64_t samples, const float* u, float* theta_i, float* phi,
            float* density, float* value) {
    for (std::int64_t s = 0; s < samples; s++)
        for (std::int64_t b = 0, i = s * count; b < count; b++, i++) {
            const h::AngleSample drawn = h::sample_angles(c[b], vector_at(u, i));
            theta_i[i] = drawn.theta_i;
            phi[i] = drawn.phi;
            density[i] = drawn.pdf;
            put(value, i, drawn.f);
        }
}

// contexts that are met once: prepared, one sample each
void shade(const float* theta_r, const float* n, const float* v, std::int64_t count, const float* u, float* theta_i,
           float* phi, float* density, float* value) {
    for (std::int64_t b = 0; b < count; b++) {
        const h::AngleSample drawn = h::sample_angles(h::prepare(theta_r[b], n[b], v[b]), vector_at(u, b));
        theta_i[b] = drawn.theta_i;
        phi[b] = drawn.phi;
        density[b] = drawn.pdf;
        put(value, b, drawn.f);
    }
}

// by unit vectors [count, 3]: f, f_pbrt and pdf of pairs; and a draw for each wo, with f, pdf and f_pbrt there
void vectors(const float* wo, const float* wi, const float* n, const float* v, std::int64_t count, float* f,
             float* f_pbrt, float* density) {
    for (std::int64_t b = 0; b < count; b++) {
        const h::Vector o = vector_at(wo, b), i = vector_at(wi, b);
        put(f, b, h::f(o, i, n[b], v[b]));
        put(f_pbrt, b, h::f_pbrt(o, i, n[b], v[b]));
        density[b] = h::pdf(o, i, n[b], v[b]);
    }
}

void sample_vectors(const float* wo, const float* u, const float* n, const float* v, std::int64_t count, float* wi,
                    float* density, float* value) {
    for (std::int64_t b = 0; b < count; b++) {
        const h::Sample drawn = h::sample(vector_at(wo, b), vector_at(u, b), n[b], v[b]);
        put(wi, b, drawn.wi);
        density[b] = drawn.pdf;
        put(value, b, drawn.f);
    }
}
}
