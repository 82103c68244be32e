"""The constants of the picture's look."""

# The mass-point mesh: its colour, the width of a line [px], and how much of the surface it hides.
WIRE_COLOUR = (235, 245, 255)
WIRE_WIDTH = 1.0
WIRE_OPACITY = 0.75
