"""Runs of a scene: simulate, draw, write, resume and read results."""
