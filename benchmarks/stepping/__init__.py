"""Peers of the time stepping; the first is this program."""

PEERS = {
    "taichi_msm": "benchmarks.stepping.msm",
    "taichi_msm, f64": "benchmarks.stepping.msm_f64",
    "C++, OpenMP": "benchmarks.stepping.cpp",
    "Numba": "benchmarks.stepping.numba_",
    "plain Taichi": "benchmarks.stepping.plain_taichi",
    "JAX": "benchmarks.stepping.jax_",
    "NumPy": "benchmarks.stepping.numpy_",
}

# Peers at every size and number of threads.
FASTEST = {name: PEERS[name] for name in ("taichi_msm", "C++, OpenMP", "Numba")}
