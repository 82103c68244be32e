"""The constants that decide the look of the picture."""

# The mass-point mesh: its colour, the width of a line [px], and how much of the surface it hides.
WIRE_COLOUR = (235, 245, 255)
WIRE_WIDTH = 1.0
WIRE_OPACITY = 0.75

# A sample of tissue that is at most this many texels wide shows the texture at full size: the filter has two texels.
SHARP = 2.0

# Where the light is, to the right of the eye and above it, as a fraction of the distance to what the camera looks at.
LIGHT_RIGHT, LIGHT_UP = -0.3, 0.0

# How far around the surface light wraps, and how narrow highlights are: (M V)^(2^SHARPNESS).
WRAP = 0.3
SHARPNESS = 3

# Share of the light that an instrument takes from the tissue that it touches.
SHADE = 0.7

# Metal: its colour; the shares of ambient light, of diffuse light and of the reflected room; and the brightness of its
# highlight, as a fraction of white.
METAL = (176.0, 182.0, 190.0)
METAL_AMBIENT, METAL_DIFFUSE, METAL_MIRROR, METAL_GLOSS = 0.2, 0.35, 0.6, 0.7

# The least depth at which metal is lit, in units of the distance from the light to the middle of the picture.
METAL_NEAREST = 0.2
