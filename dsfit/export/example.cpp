// Proves an exported sampler: its density integrates to 1, its draws follow the density, and f / pdf has the albedo
// that dsfit computed by quadrature. Build: g++ -std=c++17 -O3 -march=native example.cpp -o example && ./example
#include "hair.h"

#include <chrono>
#include <cstdio>
#include <random>

constexpr double pi = 3.14159265358979;

struct Mean {  // of numbers, with its standard error
    double sum = 0, squares = 0, count = 0;
    void add(double x) { sum += x, squares += x * x, count++; }
    double value() const { return sum / count; }
    double error() const { return std::sqrt(std::max(squares / count - value() * value(), 0.0) / count); }
};

double integral_of_pdf(const hair::Context& context) {
    double total = 0;
    const int rows = 1000, columns = 500;
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++) {
            const double theta = pi * ((i + 0.5) / rows - 0.5), phi = pi * (j + 0.5) / columns;
            total += hair::pdf(context, float(theta), float(phi)) * std::cos(theta);
        }
    return total * pi / rows * 2 * pi / columns;
}

int main() {
    std::mt19937 generator(1);
    std::uniform_real_distribution<float> uniform;
    bool good = true;
    auto check = [&](const char* name, double found, double expected, double error) {
        const bool ok = std::abs(found - expected) <= error;
        const char* verdict = ok ? "ok" : "WRONG";
        std::printf("  %-22s %.6g, expected %.6g, within %.1g: %s\n", name, found, expected, error, verdict);
        good = good && ok;
    };
    for (const hair::Known& known : hair::known) {
        std::printf("theta_r = %g, n = %g, v = %g\n", known.theta_r, known.n, known.v);
        const hair::Vector wo = {std::sin(known.theta_r), std::cos(known.theta_r), 0.0f};
        const hair::Context context = hair::prepare(wo, known.n, known.v);
        std::array<Mean, hair::channels> albedo;
        Mean sphere;
        for (int k = 0; k < 200000; k++) {
            const hair::Sample s = hair::sample(context, {uniform(generator), uniform(generator), uniform(generator)});
            for (int c = 0; c < hair::channels; c++) albedo[c].add(s.f[c] / s.pdf);
            sphere.add(1 / s.pdf);
        }
        check("integral of the pdf", integral_of_pdf(context), 1, 2e-3);
        check("mean of 1 / pdf", sphere.value(), 4 * pi, 4.5 * sphere.error());
        for (int c = 0; c < hair::channels; c++)  // tables are good to some 1e-4
            check("albedo", albedo[c].value(), known.albedo[c], 4.5 * albedo[c].error() + 5e-4 * known.albedo[c]);
    }
    const auto start = std::chrono::steady_clock::now();
    double sum = 0;
    const int contexts = 100000;
    for (int k = 0; k < contexts; k++) {
        const hair::Context context = hair::prepare(1.5f * uniform(generator), 10 * uniform(generator), 0.5f);
        sum += hair::sample_angles(context, {uniform(generator), uniform(generator), uniform(generator)}).pdf;
    }
    const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
    std::printf("%.2f million contexts/s, each with one sample, pdf and f (mean pdf %.3g)\n",
                contexts / seconds.count() / 1e6, sum / contexts);
    return good ? 0 : 1;
}
