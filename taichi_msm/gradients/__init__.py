"""Gradients of a loss by the exact adjoint of the discrete steps."""
