"""Playback of pictures in a notebook."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import ArgumentError

_player_numbers = count()


class Player:
    """Playback of pictures, each of shape (height, width, 3), in a notebook, with a button and a slider."""

    def __init__(self, frames: Sequence[NDArray[np.uint8]], rate: float) -> None:
        self.frames = tuple(frames)
        if not self.frames:
            raise ArgumentError("frames: none; take at least one")
        self.rate = rate

    def _repr_html_(self) -> str:
        sources = [jpeg_data_url(frame) for frame in self.frames]
        html = Template(Path(__file__).with_name("player.html").read_text(encoding="utf-8"))
        name, rate = f"taichi-msm-{next(_player_numbers)}", f"{self.rate:g}"
        return html.substitute(name=name, first=sources[0], last=len(sources) - 1, frames=sources, rate=rate)


def jpeg_data_url(picture: NDArray[np.uint8]) -> str:
    """Encode a picture, shape (height, width, 3), as a data URL with a JPEG."""
    file = io.BytesIO()
    # At this quality, artefacts are invisible, and hundreds of frames fit into a notebook.
    Image.fromarray(picture).save(file, "JPEG", quality=92)
    return f"data:image/jpeg;base64,{b64encode(file.getvalue()).decode()}"
