"""Stepping beside other ways to write it; the first peer is this program."""

PEERS = {
    "taichi_msm": "benchmarks.stepping.msm",
    "taichi_msm, f64": "benchmarks.stepping.msm_f64",
    "C++, OpenMP": "benchmarks.stepping.cpp",
    "Numba": "benchmarks.stepping.numba_",
    "plain Taichi": "benchmarks.stepping.plain_taichi",
    "JAX": "benchmarks.stepping.jax_",
    "NumPy": "benchmarks.stepping.numpy_",
}

# Those that are timed at every size and with every number of threads.
FASTEST = {name: PEERS[name] for name in ("taichi_msm", "C++, OpenMP", "Numba")}
