"""Lens models: the table of them, and a file per model."""

from taichi_msm.lenses.fisheye import Fisheye
from taichi_msm.lenses.model import LensModel
from taichi_msm.lenses.rational import Rational

MODELS: dict[str, LensModel] = {model.name: model for model in (Rational(), Fisheye())}
