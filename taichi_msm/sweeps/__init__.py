"""Sweeps: runs of one scene with varied values, their execution, and reports of their results."""
