"""The sheet in NumPy: mass points, loads, tools, plan."""
