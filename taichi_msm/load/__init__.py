"""Reading of scene files, validation, and estimates of the cost of a run."""
