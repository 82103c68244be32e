"""Deform an image as tissue deforms."""

__version__ = "0.1.0"
