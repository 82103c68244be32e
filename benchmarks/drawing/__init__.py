"""Peers of the drawing; the first is this program."""

# Peers that draw the same scene: the refined surface, lit.
LIT = {
    "taichi_msm": "benchmarks.drawing.msm",
    "moderngl": "benchmarks.drawing.moderngl_",
    "VTK": "benchmarks.drawing.vtk_",
}

# Peers that warp the picture without light, and this program without light.
FLAT = {
    "taichi_msm": "benchmarks.drawing.msm",
    "cv2.remap": "benchmarks.drawing.cv2_",
    "cv2.remap, maps ready": "benchmarks.drawing.cv2_ready",
    "PiecewiseAffineTransform": "benchmarks.drawing.skimage_",
}
