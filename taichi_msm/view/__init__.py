"""The live session: interactive simulation in a window, or filmed from a script."""
