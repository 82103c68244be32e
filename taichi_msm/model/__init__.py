"""The sheet as NumPy arrays: mass points, loads, tools and the plan of a run."""
