"""Speed of the program against other implementations of the same work: `python -m benchmarks`."""
