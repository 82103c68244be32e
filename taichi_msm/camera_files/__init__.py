"""Readers of camera calibrations and trajectories from other programs: a file per format, behind two tables."""
