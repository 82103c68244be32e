"""Detection of divergence: NaN, a mass point too far away, or more energy than the load can have supplied."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from taichi_msm.accuracy.contact_warnings import first_piercing_probe
from taichi_msm.model.loads import LoadBounds
from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import heights, rest_of
from taichi_msm.solver.state import LargestDisplacement, Reading, RunProgress, largest_displacement
from taichi_msm.terms import TERMS
from taichi_msm.terms.foundation import FoundationTerm, foundation_energy, point_shares
from taichi_msm.terms.loads import decay_norm_bound, max_free_acceleration

# Factor by which the energy may exceed the energy supplied by the loads. The energy of Verlet's method exceeds the true
# energy by a factor of up to 1 / (1 - (h / h_stable)^2), and somewhat more where springs are compressed to a point.
ENERGY_OSCILLATION = 4.0


def displacement_bound(
    plan: Plan, time: float, acceleration: float | None = None, tool_energy: float | None = None
) -> float:
    """Return the largest displacement of a mass point in a sound run [m]; infinite if a foundation can accelerate it.

    `time` [s] is since the start. By default, the bounds of the acceleration of a free mass point [m/s^2], and of the
    energy supplied by position-controlled tools so far [J], are those of the scene.
    """
    # Deformation moves a mass point by at most ten sizes of the sheet; a tool moves the tissue that it holds along its
    # path.
    bound = 10.0 * rest_of(plan.scene.sheet).extent + sum(tool.reach for tool in plan.tools)
    # Springs along rows and columns connect every mass point to a held one. Shear springs alone may connect only half.
    if plan.is_held and min(plan.material.across, plan.material.down) > 0:
        return bound
    if plan.material.virtual > 0 and not plan.material.always_active:
        # Virtual springs may accelerate a distant mass point, and become inactive when it is fast.
        return math.inf
    if plan.tools:
        # Speed of the mass points if the supplied energy is kinetic and equally distributed.
        supplied = _tool_energy_bound(plan) if tool_energy is None else tool_energy
        bound += math.sqrt(2 * supplied / plan.fixed.size / plan.material.mass) * time
    return bound + (max_free_acceleration(plan) if acceleration is None else acceleration) * time * time / 2


class DivergenceMonitor:
    """Divergence checks of the frames of a run.

    Let E be the energy of motion and springs, F the forces of the probes, and |F| and |v| the norms over all mass
    points. Damping only removes energy, and the probes add dE/dt <= |F| |v|, with |v| <= (2 E / m)^(1/2). So from time
    a to b

        E(b)^(1/2) <= E(a)^(1/2) + (2 m)^(-1/2) integral of |F| from a to b

    Position-controlled tools add E_T^(1/2) to the right-hand side, where E_T is the energy to displace every mass point
    at the tool's speed by the length of its path plus its radius. The sum of roots instead of energies allows for a
    deformed sheet, which requires more energy. The virtual springs add at most K / 2 |u|^2 to E, with the largest K;
    whenever they become active, this is added for the current displacements. Stress relaxation with G, the sum of the
    shares, returns at most 4 G of the largest E so far, and E is at most 1 / (1 - G) times the energy of the sheet.

    A growth of the energy after the last load shows steps that are too long for compressed springs, see
    `energy_growth_warnings`.
    """

    def __init__(self, plan: Plan, progress: RunProgress | None = None) -> None:
        self.progress = progress or RunProgress()  # at the last frame without a fault, initially at the first one
        self._grid, material = plan.grid, plan.material
        self._acceleration = self._tool_energy = 0.0
        self._load_norms = np.array([decay_norm_bound(slot, plan) for slot in plan.slots])
        self._oscillation = ENERGY_OSCILLATION / max(1e-9, 1 - (plan.grid.step / plan.stable_step) ** 2)
        self._relaxing_share = sum(share for share, _ in material.relaxation)
        self._oscillation /= 1 - self._relaxing_share
        self._underflow = _underflow_energy(plan)
        # Stiffness of the virtual springs after the last load [N/m], shape (rows, cols); 0 if active only under load.
        lasting = material.always_active and material.virtual > 0
        self._lasting_stiffness = material.virtual * point_shares(plan) if lasting else np.zeros((1, 1))
        self.change_loads(plan)

    def change_loads(self, plan: Plan) -> None:
        """Replace the loads from now on; fixed control points must remain fixed, and moving ones moving."""
        self._plan, self._loads = plan, LoadBounds(plan)
        self._acceleration = max(self._acceleration, max_free_acceleration(plan))
        self._tool_energy = max(self._tool_energy, _tool_energy_bound(plan))

    def check_frame(self, reading: Reading) -> str:
        """Check the next frame like `check`; without a fault, record its progress."""
        extreme, progress = largest_displacement(reading.displacement), self.progress
        frame, fault = reading.steps // self._grid.steps_per_frame, self._fault(reading, extreme)
        if not fault:
            least_energy, growth = self._energy_growth(reading, frame)
            is_largest = extreme.distance > progress.max_displacement
            pierced_by = progress.pierced_by or first_piercing_probe(self._plan, reading.displacement, frame)
            is_first_piercing = pierced_by and not progress.pierced_by
            height = heights(reading.displacement, self._plan.scene.sheet)
            self.progress = RunProgress(
                frame=frame,
                max_displacement=max(progress.max_displacement, extreme.distance),
                max_displacement_frame=frame if is_largest else progress.max_displacement_frame,
                shortest_spring=min(progress.shortest_spring, reading.shortest_spring),
                longest_spring=max(progress.longest_spring, reading.longest_spring),
                energy=reading.energy,
                reach=extreme.reach,
                deepest=max(progress.deepest, -float(height.min())),
                highest=max(progress.highest, float(height.max())),
                peak=max(progress.peak, reading.energy),
                residual=max(progress.residual, reading.residual),
                evaluations=progress.evaluations + reading.evaluations,
                least_energy=least_energy,
                energy_growth=growth,
                pierced_by=pierced_by,
                pierced_frame=frame if is_first_piercing else progress.pierced_frame,
            )
        return fault

    def _energy_growth(self, reading: Reading, frame: int) -> tuple[float, float]:
        """Return the smallest energy of a frame after the last load [J], 0 until then, and the largest growth."""
        least, growth = self.progress.least_energy, self.progress.energy_growth
        # Stress relaxation returns energy, so growth is not an error.
        time, release = frame / self._grid.frames_per_second, _release_time(self._plan) + self._grid.step
        if self._plan.material.relaxation or time < release:
            return least, growth
        displacement = reading.displacement.astype(np.float64)
        energy = reading.energy + foundation_energy(self._plan, self._lasting_stiffness, displacement)
        # Energies below 1e-3 of the largest may grow by rounding, without effect on the result.
        if least > 0 and energy > max(least, 1e-3 * self.progress.peak):
            growth = max(growth, energy / least)
        return min(least or energy, energy), growth

    def check(self, reading: Reading) -> str:
        """Describe the fault at a step after the last recorded frame; return an empty string without a fault."""
        return self._fault(reading, largest_displacement(reading.displacement))

    def _fault(self, reading: Reading, extreme: LargestDisplacement) -> str:
        if self._plan.scene.time.at_rest:
            return ""  # The solver itself reports a missing equilibrium.
        begin, end = self.progress.frame / self._grid.frames_per_second, self._grid.time(reading.steps)
        point, distance, energy = f"point ({extreme.row}, {extreme.column})", extreme.distance, reading.energy
        # The negated comparisons also detect NaN, for which every comparison is false.
        if not distance <= displacement_bound(self._plan, end, self._acceleration, self._tool_energy):
            size = rest_of(self._plan.scene.sheet).extent
            return f"{point} is {distance:g} m from its rest position, and the sheet is {size:g} m long"
        bound = self._energy_bound(begin, end)
        if not energy < math.inf or energy > bound:
            return (
                f"motion and springs hold {energy:.3g} J, and the load explains {bound:.3g} J at most; "
                f"{point} is farthest from its rest position, {distance:g} m"
            )
        return ""

    def _energy_bound(self, begin: float, end: float) -> float:
        """Bound the energy at the end of an interval that begins at the last recorded frame [J]."""
        progress, material = self.progress, self._plan.material
        mass, virtual = material.mass, FoundationTerm.stiffness_bound(material, self._plan.scene.sheet) / 2
        forces, active, activations = self._loads.between(begin, end)
        force = float((forces * self._load_norms).sum())
        remembered = 4 * self._relaxing_share * progress.peak
        # Squares as products, which become infinite where a power would raise OverflowError.
        root = math.sqrt(progress.energy + remembered + active * virtual * progress.reach * progress.reach)
        root += force * (end - begin) / math.sqrt(2 * mass) + math.sqrt(self._tool_energy)
        reach = progress.reach + (end - begin) * root * math.sqrt(2 / mass)
        for _ in range(activations):
            root = math.sqrt(root * root + virtual * reach * reach)
            reach += (end - begin) * root * math.sqrt(2 / mass)
        # Rounding may add 1e-9 of the largest energy so far.
        return self._oscillation * root * root + 1e-9 * progress.peak + self._underflow


def format_message(time: float, step: int, fault: str, *, exact: bool) -> str:
    """Return the message about a divergence; `exact`: whether the previous step is known to have no fault."""
    return f"diverged {'at' if exact else 'before'} {time:.6g} s, step {step}: {fault}"


def _tool_energy_bound(plan: Plan) -> float:
    """Bound the energy that position-controlled tools can supply to the mass points [J]."""
    material, step, energy = plan.material, plan.grid.step, 0.0
    stiffness = sum(term.stiffness_bound(material, plan.scene.sheet) for term in TERMS)
    for tool in plan.tools:
        distance, speed = tool.reach, tool.max_stride(step)[0] / step
        energy += (stiffness * distance * distance + material.mass * speed * speed) / 2
    return plan.fixed.size * energy


def _underflow_energy(plan: Plan) -> float:
    """Return the energy below which the squares in its sum may underflow [J]."""
    tiny = float(np.finfo(np.float32 if plan.grid.precision == "f32" else np.float64).tiny)
    (dx, dy), material = rest_of(plan.scene.sheet).cell_sides, plan.material
    inertia = material.mass / plan.grid.step**2
    # The sums contain squares with and without a factor of stiffness.
    springs = max(1.0, sum(term.stiffness_bound(material, plan.scene.sheet) for term in TERMS)) * (dx**2 + dy**2)
    return math.prod(plan.scene.sheet.points) * tiny * (inertia + springs)


def _release_time(plan: Plan) -> float:
    """Return the time at which all loads and paths have ended [s], infinite for a load without end."""
    ends = [tool.times[-1] for tool in plan.tools]
    for probe in plan.scene.probes:
        if not probe.moved and any(percent for _, percent in probe.load):
            ends.append(probe.load[-1][0] if probe.load[-1][1] == 0 else math.inf)
    return float(max(ends, default=0.0))


def energy_growth_warnings(plan: Plan, progress: RunProgress) -> Iterator[str]:
    """Yield a warning if the energy grew after the last load, beyond its oscillation with this time step.

    The energy is measured from the position x_n and the velocity half a step before. For a mode of frequency w it is
    between 1 - w h / 2 and 1 + w h / 2 times the energy that Verlet's method conserves, where w h / 2 is at most
    r = h / h_stable. Hence a factor above (1 + r) / (1 - r) between two energies is growth.

    Source: Hairer, Lubich and Wanner 2003, Acta Numerica 12, 399-450, on the conserved energy.
    """
    ratio = plan.grid.step / plan.stable_step
    if progress.energy_growth * (1 - ratio) > 1 + ratio:
        yield (
            f"the energy grew by a factor of {progress.energy_growth:.3g} after {_release_time(plan):.6g} s, without "
            "an active probe: the steps are too long for compressed springs, and the motion from there on is invalid; "
            f"try time.step: {plan.grid.step / 2:.6g}, press less, or take more damping"
        )
