"""OpenGL by moderngl, on a CPU by llvmpipe: mass points are textures; shaders refine, light and filter."""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from benchmarks.drawing.problem import POINTS, SIDE, Picture, Problem
from benchmarks.process import UnavailableError

# Refinement as in reference.refine: vertex (row, column) lies between four mass points.
VERTEX = """
#version 330
uniform sampler2D point;
uniform sampler2D normal;
uniform int parts;
uniform int vertices;
uniform int points;
uniform float side;
out vec2 coordinates;
out float light;

vec3 between(sampler2D values, ivec2 low, vec2 share) {
    vec3 upper = mix(texelFetch(values, low, 0).xyz, texelFetch(values, low + ivec2(1, 0), 0).xyz, share.x);
    vec3 lower = mix(texelFetch(values, low + ivec2(0, 1), 0).xyz, texelFetch(values, low + ivec2(1), 0).xyz, share.x);
    return mix(upper, lower, share.y);
}

void main() {
    ivec2 vertex = ivec2(gl_VertexID % vertices, gl_VertexID / vertices);
    ivec2 low = min(vertex / parts, ivec2(points - 2));
    vec2 share = vec2(vertex - low * parts) / parts;
    vec3 position = between(point, low, share);
    light = abs(normalize(between(normal, low, share)).z);
    coordinates = vec2(vertex) / (vertices - 1);
    gl_Position = vec4(position.x * 2 / side, -position.y * 2 / side, -position.z / side, 1);
}
"""

FRAGMENT = """
#version 330
uniform sampler2D picture;
uniform bool lit;
in vec2 coordinates;
in float light;
out vec4 colour;

void main() {
    colour = vec4(texture(picture, coordinates).rgb * (lit ? light : 1.0), 1);
}
"""


class OpenGl:
    """An offscreen context with the sheet."""

    def __init__(self, problem: Problem) -> None:
        try:
            self._context = context = moderngl.create_context(standalone=True, backend="egl")
        except Exception as error:
            raise UnavailableError(f"no offscreen OpenGL: {error}") from None
        n, pixels = problem.vertices, problem.pixels
        context.enable(moderngl.DEPTH_TEST)
        program = context.program(VERTEX, FRAGMENT)
        names = {"point": 0, "normal": 1, "picture": 2, "parts": problem.refine + 1, "vertices": n, "points": POINTS}
        for name, value in {**names, "side": SIDE, "lit": problem.lit}.items():
            program[name] = value
        self._point, self._normal = (context.texture((POINTS, POINTS), 3, dtype="f4") for _ in range(2))
        texture = problem.texture
        self._picture = context.texture(texture.shape[1::-1], 3, texture.tobytes(), alignment=1)
        self._picture.filter = moderngl.LINEAR, moderngl.LINEAR
        self._picture.repeat_x = self._picture.repeat_y = False
        quad = np.arange(n - 1)[:, None, None] * n + np.arange(n - 1)[:, None]
        # The diagonal of each quad leads from its top left to its bottom right corner.
        index = context.buffer(np.add(quad, [0, n, n + 1, 0, n + 1, 1]).astype(np.int32).tobytes())
        self._sheet = context.vertex_array(program, [], index_buffer=index)
        self._frame = context.framebuffer(
            [context.texture((pixels, pixels), 3)], context.depth_renderbuffer((pixels, pixels))
        )
        self._out = np.empty((pixels, pixels, 3), np.uint8)

    def draw(self, position: NDArray[np.float32]) -> Picture:
        """Draw the sheet; the first row of the frame is the picture's top, as y is turned round."""
        across, down = np.gradient(position, axis=1), np.gradient(position, axis=0)
        normal = np.cross(across, -down)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        self._point.write(np.ascontiguousarray(position))
        self._normal.write(np.ascontiguousarray(normal, np.float32))
        for unit, texture in enumerate((self._point, self._normal, self._picture)):
            texture.use(unit)
        self._frame.use()
        self._frame.clear()
        self._sheet.render()
        self._frame.read_into(self._out, components=3, alignment=1)
        return self._out


def prepare(problem: Problem, threads: int | None) -> OpenGl:
    """Set up OpenGL; llvmpipe reads the number of threads from the environment."""
    del threads
    return OpenGl(problem)
