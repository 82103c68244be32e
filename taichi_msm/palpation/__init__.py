"""Palpation: many presses of a ball at many places, and a map of the stiffness from them."""
