"""The command line, a file for each command."""

import time

# The clock starts before the other imports do.
STARTED = time.perf_counter()
