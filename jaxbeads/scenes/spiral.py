"""Spiral swimmer: two perpendicular waves of curvature in quadrature."""

import equinox as eqx
import numpy as np

from .._checks import positive, whole
from ..actuation import TravellingWave, TwoPlanes
from ..chain import Chain, straight
from ..constraint import Gears
from ..dynamics import motion
from ..force import Bending
from ..objectives import displacement, mean_over_time
from ..scene import Scene
from ..solution import Solution
from ..state import Motion
from .case import (
    SAMPLES,
    Case,
    ReadyMade,
    Value,
    distance_swum,
    last_period,
    until_periodic,
    worm_amplitude,
)

__all__ = ["SPIRAL", "spiral"]


def spiral(
    beads: int = 15,
    frequency: float = 22.6,
    *,
    curvature: float = 2.0,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """A Gears chain in space that bends in two perpendicular planes, a quarter of a period apart: a
    helical wave runs along it, and it swims against the wave. From straight until the swimming is
    periodic.

    Each plane has the nematode's wave, with the peak curvature `curvature` / L (see
    `actuation.TwoPlanes`). The shape turns about the axis once a period; the beads counter-rotate,
    because no torque acts on the whole: `rotation` is their mean spin about the swimming axis over
    2 pi f. It grows about as the square of the slenderness, N^2, because thin beads resist little.

    **Arguments**: number of beads (at least 4); frequency as 2 pi f mu L^4/K_b; peak curvature
    times L; a [length]; mu. The time unit is a period.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.spiral(beads=4)
    >>> print(case.state.position.shape, type(case.scene.forces[0].intrinsic_curvature).__name__)
    (4, 3) TwoPlanes
    """
    whole("beads", beads, 4)
    positive("frequency", frequency)
    positive("curvature", curvature)
    chain = Chain(radius, beads)
    length = chain.length[0]
    rigidity = 2 * np.pi * viscosity * length**4 / frequency
    amplitude = worm_amplitude(chain, curvature)
    waves = [TravellingWave(amplitude, 1.5 * np.pi / length, 1.0, p) for p in (0.0, np.pi / 2)]
    bending = Bending(rigidity, TwoPlanes(*waves))
    scene = Scene(chain, viscosity, constraints=[Gears()], forces=[bending])
    tolerance = 1e-5 * float(length)
    ts = np.linspace(0.0, 30.0, 30 * SAMPLES + 1)
    return Case(
        scene,
        straight(chain, [1.0, 0.0, 0.0]),
        ts,
        until=until_periodic(tolerance),
        chunk=SAMPLES,
    )


@eqx.filter_jit
def _mean_motion(period: Solution, scene: Scene) -> Motion:
    return mean_over_time(motion, period, scene)


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    scene = case.scene
    period = last_period(solution)
    moved = np.asarray(displacement(period))
    spin = np.asarray(_mean_motion(period, scene).spin).mean(axis=0)
    return {
        "speed": float(np.linalg.norm(moved) / scene.chain.length[0]),
        "rotation": float(spin @ moved / np.linalg.norm(moved)) / (2 * np.pi),
    }


SPIRAL = ReadyMade(
    "spiral",
    "swimmer with a helical wave: speed and rotation",
    spiral,
    {"beads": "number of beads", "frequency": "frequency as 2 pi f mu L^4/K_b"},
    _observables,
    {
        "speed": "displacement in a period over L",
        "rotation": "mean turns about the path in a period",
    },
    ("distance swum over $L$", distance_swum),
    co_moving=False,
    shown=last_period,
    quick="--beads 7 --frequency 10.0",
)
