"""The machine: Taichi, cores and memory, signals, streams."""
