"""The command line, with a module for each group of commands."""

import time

# Timings of a run include the time of the imports.
START_TIME = time.perf_counter()
