"""Kernel 2 and what belongs to it: the camera, the texture, the picture."""
