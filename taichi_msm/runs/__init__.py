"""One run: stepping, drawing, writing, resuming."""
