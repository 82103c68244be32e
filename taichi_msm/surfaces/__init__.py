"""Surfaces from depth maps and from grids of points, and grids that are even on them."""
