"""The machine: compiler, cores, memory, signals, standard streams."""
