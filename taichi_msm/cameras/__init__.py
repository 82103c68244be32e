"""Cameras below the scene: lens, extrinsics, and the view from a point in the world to pixels."""
