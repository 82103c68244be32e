"""The live session and its window."""
