"""Tests of testing machines: their tables, and their motion as that of a scene's tool."""
