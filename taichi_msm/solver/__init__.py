"""Time stepping and equilibrium: arrays, kernels, drivers."""
