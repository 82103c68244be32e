"""Rendering: cameras, textures, light, instruments, pictures and labels."""
