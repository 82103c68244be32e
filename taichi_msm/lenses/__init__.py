"""Lens models, one per file, and the table of all models."""

from taichi_msm.lenses.fisheye import Fisheye
from taichi_msm.lenses.model import LensModel
from taichi_msm.lenses.omnidir import Omnidir
from taichi_msm.lenses.rational import Rational
from taichi_msm.lenses.scaramuzza import Scaramuzza

MODELS: dict[str, LensModel] = {model.name: model for model in (Rational(), Fisheye(), Omnidir(), Scaramuzza())}
