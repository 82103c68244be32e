"""The machine: the compiler, cores and memory, signals, standard streams."""
