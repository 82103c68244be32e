"""The machine: Taichi, signals, streams."""
