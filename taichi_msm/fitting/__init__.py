"""The numbers of a scene from what was seen of the tissue, with their uncertainty."""
