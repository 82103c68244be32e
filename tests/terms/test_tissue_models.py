"""The laws of docs/tissue-models.md against the program's twin and closed forms."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from tests import reference
from tests.reference.dynamics import elastic_force

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import make_tissue  # type: ignore[import-not-found,unused-ignore]


@pytest.mark.parametrize(("a", "b", "g"), [(1.2, 1.0, 0.0), (1.4, 0.8, 0.3), (1.3, 1.3, 0.0)])
def test_stress_of_the_lattice(a: float, b: float, g: float) -> None:
    """The forces of the twin on a side of a stretched sheet add up to stress times section."""
    lock, factor = make_tissue.LOCK
    tissue = {"young": 2e4, "thickness": 2e-3, "density": 1000, "stiffening": {"lock": lock, "factor": factor}}
    scene = Scene.model_validate(
        {"sheet": {"points": [5, 6], "size": [0.04, 0.05]}, "tissue": tissue, "time": {"duration": 1}, "output": []}
    )
    gradient = np.array([[a, g, 0], [0, b, 0], [0, 0, 1]])
    rest = rest_positions(scene.sheet)
    force = elastic_force(scene, rest @ (gradient - np.eye(3)).T, reference.sheet(scene))
    stress = np.array([-force[:, -1, 0].sum() / 0.04, -force[0, :, 1].sum() / 0.05, -force[0, :, 0].sum() / 0.05])
    expected = list(make_tissue.lattice_stress(a, b, g))
    assert stress / (2e4 * 2e-3) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_modulus_at_small_strains() -> None:
    """E is the slope of all laws in one direction; equally in both it is E / (1 - nu), with nu 1/3 and 1/2."""
    e = 1e-6
    for angle in (0.0, 0.3, np.pi / 8):
        assert make_tissue.lattice_stress(1 + e, 1 - e / 3, 0.0, angle) == pytest.approx([e, 0, 0], abs=1e-11)
    assert make_tissue.lattice_stress(1 + e, 1 + e)[0] == pytest.approx(1.5 * e, rel=1e-5)
    for law, shape in (("exponential", 5.0), ("Ogden", 9.0)):
        for both, modulus in ((False, 1), (True, 2)):
            stress = make_tissue.solid_stress(law, shape, np.array(1 + e), both=both)
            assert stress == pytest.approx(modulus * e, rel=1e-4)


def test_loss_factor_of_fitted_branches() -> None:
    frequency = np.geomspace(make_tissue.BAND[0], make_tissue.BAND[1], 301)
    for target in make_tissue.LOSS_FACTORS:
        shares, times = make_tissue.fit_branches(target)
        assert shares.sum() < 1
        assert np.abs(make_tissue.loss_factor(shares, times, frequency) / target - 1).max() < 0.05
