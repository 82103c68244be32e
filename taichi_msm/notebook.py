"""Show frames in a notebook."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Sequence
from html import escape
from itertools import count
from string import Template

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import ArgumentError

# The quality of JPEGs: some hundred frames fit into a notebook, and no difference from the picture is visible.
QUALITY = 92

_PAGE = Template("""\
<div id="$name">
  <img alt="frame" style="display: block; max-width: 100%" src="$first">
  <button type="button">Play</button>
  <input type="range" min="0" max="$last" value="0" style="vertical-align: middle; width: 20em">
  <output>0 s</output>
  <script>
    (() => {
      const root = document.getElementById("$name"), frames = $frames, rate = $rate;
      const [image, button, range, time] = ["img", "button", "input", "output"].map(tag => root.querySelector(tag));
      const show = () => {
        image.src = frames[range.value];
        time.value = (range.value / rate).toFixed(2) + " s";
      };
      let timer = null;
      range.oninput = show;
      button.onclick = () => {
        if (timer) {
          clearInterval(timer);
          timer = null;
        } else {
          timer = setInterval(() => { range.value = (+range.value + 1) % frames.length; show(); }, 1000 / rate);
        }
        button.textContent = timer ? "Pause" : "Play";
      };
    })();
  </script>
</div>""")

_names = count()


class Player:
    """Frames with a button and a slider, which a notebook shows as the value of a cell.

    At least one picture, all of one size, shape (height, width, 3), at a rate of frames per second.
    """

    def __init__(self, frames: Sequence[NDArray[np.uint8]], rate: float) -> None:
        self.frames = tuple(frames)
        if not self.frames:
            raise ArgumentError("frames: none; take at least one")
        self.rate = rate

    def _repr_html_(self) -> str:
        sources = [source(frame) for frame in self.frames]
        return _PAGE.substitute(
            name=f"taichi-msm-{next(_names)}",
            first=sources[0],
            last=len(sources) - 1,
            frames=sources,
            rate=f"{self.rate:g}",
        )


def source(picture: NDArray[np.uint8]) -> str:
    """Write a picture as a data URL."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{b64encode(file.getvalue()).decode()}"


def captioned(picture: NDArray[np.uint8], caption: str) -> str:
    """Write the HTML of a picture with a caption below it."""
    return f'<figure><img alt="" src="{source(picture)}"><figcaption>{escape(caption)}</figcaption></figure>'
