"""The constants of the picture's look."""

# The mass-point mesh: its colour, the width of a line [px], and how much of the surface it hides.
WIRE_COLOUR = (235, 245, 255)
WIRE_WIDTH = 1.0
WIRE_OPACITY = 0.75

# Up to so many texels wide, a sample of tissue shows the texture as it is: the filter is two texels wide.
SHARP = 1.5

# Where the light is, to the right of the eye and above it, by the distance to what is looked at.
LIGHT_RIGHT, LIGHT_UP = -0.3, 0.0

# How far around the surface light wraps, and how narrow highlights are: (M V)^(2^SHARPNESS).
WRAP = 0.3
SHARPNESS = 3

# Share of the light that an instrument keeps from the tissue that it touches.
SHADE = 0.7

# Metal: its colour, the share of it that is always there, that of the light, and that of the bright half of what it
# mirrors; and its highlight, by white.
METAL = (176.0, 182.0, 190.0)
METAL_AMBIENT, METAL_DIFFUSE, METAL_MIRROR, METAL_GLOSS = 0.2, 0.35, 0.6, 0.7
