// The problem of problem.py as one would write it by hand: all steps in one parallel region, rows shared out once,
// columns in vector instructions, coordinates apart, u_{n+1} written over u_{n-1}.

#include <cmath>
#include <cstdint>
#include <utility>

namespace {

struct Numbers {
    float dx, dy, structural, shear, virtual_, keep, gain, first_gain;
};

inline void pull(const float *ux, const float *uy, const float *uz, std::int64_t at, float x, float y, float z,
                 float off_x, float off_y, float length, float stiffness, float &fx, float &fy, float &fz) {
    const float to_x = ux[at] - x + off_x, to_y = uy[at] - y + off_y, to_z = uz[at] - z;
    const float scale = stiffness - stiffness * length / std::sqrt(to_x * to_x + to_y * to_y + to_z * to_z);
    fx += scale * to_x;
    fy += scale * to_y;
    fz += scale * to_z;
}

}  // namespace

// now, before: u_n and u_{n-1}, shape (3, n, n); share: the decay of the load, shape (n, n); done: steps taken so far.
extern "C" void advance(float *now, float *before, const float *share, const float *force, const Numbers *numbers,
                        std::int64_t n, std::int64_t done, std::int64_t steps) {
    const Numbers c = *numbers;
    const float load_x = force[0], load_y = force[1], load_z = force[2];
    const float diagonal = std::sqrt(c.dx * c.dx + c.dy * c.dy);
    const std::int64_t plane = n * n;
#pragma omp parallel
    {
        float *u = now, *w = before;
        for (std::int64_t step = done; step < done + steps; ++step) {
            const float gain = step ? c.gain : c.first_gain;
#pragma omp for schedule(static)
            for (std::int64_t i = 1; i < n - 1; ++i) {
                const float *ux = u + i * n, *uy = ux + plane, *uz = uy + plane, *s = share + i * n;
                float *wx = w + i * n, *wy = wx + plane, *wz = wy + plane;
#pragma omp simd
                for (std::int64_t j = 1; j < n - 1; ++j) {
                    const float x = ux[j], y = uy[j], z = uz[j];
                    float fx = load_x * s[j] - c.virtual_ * x;
                    float fy = load_y * s[j] - c.virtual_ * y;
                    float fz = load_z * s[j] - c.virtual_ * z;
                    pull(ux, uy, uz, j - 1, x, y, z, -c.dx, 0, c.dx, c.structural, fx, fy, fz);
                    pull(ux, uy, uz, j + 1, x, y, z, c.dx, 0, c.dx, c.structural, fx, fy, fz);
                    pull(ux, uy, uz, j - n, x, y, z, 0, c.dy, c.dy, c.structural, fx, fy, fz);
                    pull(ux, uy, uz, j + n, x, y, z, 0, -c.dy, c.dy, c.structural, fx, fy, fz);
                    pull(ux, uy, uz, j - n - 1, x, y, z, -c.dx, c.dy, diagonal, c.shear, fx, fy, fz);
                    pull(ux, uy, uz, j - n + 1, x, y, z, c.dx, c.dy, diagonal, c.shear, fx, fy, fz);
                    pull(ux, uy, uz, j + n - 1, x, y, z, -c.dx, -c.dy, diagonal, c.shear, fx, fy, fz);
                    pull(ux, uy, uz, j + n + 1, x, y, z, c.dx, -c.dy, diagonal, c.shear, fx, fy, fz);
                    wx[j] = x + c.keep * (x - wx[j]) + gain * fx;
                    wy[j] = y + c.keep * (y - wy[j]) + gain * fy;
                    wz[j] = z + c.keep * (z - wz[j]) + gain * fz;
                }
            }
            std::swap(u, w);
        }
    }
}
