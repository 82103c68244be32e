"""The live session: interactive simulation in browsers, or filmed from a script."""
