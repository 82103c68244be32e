// What the machine can do: bytes a second, multiplications with addition, and reciprocal square roots.

#include <cmath>
#include <cstdint>

#ifdef __AVX512F__
constexpr int WIDTH = 64;
#else
constexpr int WIDTH = 32;
#endif

// So many chains hide the latency of an instruction.
constexpr int CHAINS = 10;
constexpr int LANES = WIDTH / 4;
typedef float Vector __attribute__((vector_size(WIDTH)));

// a = b + 3 c, shape (n,), again and again: every thread on its own stretch.
extern "C" void triad(float *a, const float *b, const float *c, std::int64_t n, std::int64_t repeats) {
#pragma omp parallel
    for (std::int64_t round = 0; round < repeats; ++round) {
#pragma omp for simd schedule(static) nowait
        for (std::int64_t i = 0; i < n; ++i) a[i] = b[i] + 3.0f * c[i];
    }
}

// Gives back how many operations all threads did; a multiplication with addition counts as two.
extern "C" double flops(std::int64_t repeats) {
    double operations = 0;
#pragma omp parallel reduction(+ : operations)
    {
        Vector chain[CHAINS];
        for (int k = 0; k < CHAINS; ++k) chain[k] = Vector{} + float(k);
        for (std::int64_t round = 0; round < repeats; ++round) {
#pragma GCC unroll 16
            for (int k = 0; k < CHAINS; ++k) {
                chain[k] = chain[k] * 0.999f + 0.5f;
                // Else the compiler would take several rounds in one.
                asm volatile("" : "+x"(chain[k]));
            }
        }
        operations += 2.0 * CHAINS * LANES * repeats;
    }
    return operations;
}

// Gives back how many roots all threads took.
extern "C" double roots(std::int64_t repeats) {
    constexpr int COUNT = 1024;
    double taken = 0;
#pragma omp parallel reduction(+ : taken)
    {
        alignas(64) float value[COUNT];
        for (int k = 0; k < COUNT; ++k) value[k] = 1.0f + k;
        for (std::int64_t round = 0; round < repeats; ++round) {
#pragma omp simd
            for (int k = 0; k < COUNT; ++k) value[k] = 1.0f / std::sqrt(value[k]);
            asm volatile("" : : "r"(value) : "memory");
        }
        taken += double(COUNT) * repeats;
    }
    return taken;
}
