"""Gradients of a loss, by the adjoint of the discrete time steps and of the equilibrium."""
