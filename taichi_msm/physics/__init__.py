"""Kernel 1 and what belongs to it: the sheet, its loads, steps and errors."""
