"""Kernel 2 and its surroundings: the camera, the texture, light, instruments, pictures, labels."""
