"""Camera calibrations and trajectories of other programs: a file per format, and the tables of `readers`."""
