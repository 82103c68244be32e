"""Error estimates, divergence checks and warnings of a run."""
