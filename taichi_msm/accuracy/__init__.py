"""Error estimates of a run, divergence, and warnings."""
