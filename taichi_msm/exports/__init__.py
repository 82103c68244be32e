"""The results of a run in the files of other programs."""
