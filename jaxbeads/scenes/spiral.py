"""Spiral swimmer: a rod along whose material two waves of curvature run in quadrature."""

import numpy as np

from .._checks import positive, whole
from ..actuation import TravellingWave
from ..chain import Chain, straight
from ..constraint import Gears
from ..dynamics import motion
from ..force import ElasticRod
from ..scene import Scene
from ..solution import Solution
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
    twist_rigidity: float = 2 / 3,
    curvature: float = 2.0,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """A free Gears rod in space with a helical wave: it prefers the nematode's wave of curvature about
    both axes d_1 and d_2 of its material, a quarter of a period apart, and swims. From straight until
    the swimming is periodic.

    The curvature vector turns once a period in the material frames, at all places alike. So the rod
    keeps one shape, a helix bent by its drag, which turns about the axis of swimming at a rate Omega,
    while its material turns about the centreline the other way: f = |n - Omega|/2 pi, with n the spin
    about the centreline. How a period is shared between both, the torque says, which vanishes in all.
    A stout rod does not spin and its shape goes around once a period; a slender one, whose beads
    resist their own spin little, spins in a shape that hardly turns. Twist opposes unequal spin.

    **Arguments**: number of beads (at least 4); frequency as 2 pi f mu L^4/K_b; K_t/K_b, 2/3 for an
    isotropic incompressible rod; peak curvature times L; a [length]; mu. The time unit is a period.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.spiral(beads=4)
    >>> rod = case.scene.forces[0]
    >>> print(case.state.position.shape, f"{rod.twist_rigidity / rod.rigidity:.4f}")
    (4, 3) 0.6667
    """
    whole("beads", beads, 4)
    for name, value in {
        "frequency": frequency,
        "twist_rigidity": twist_rigidity,
        "curvature": curvature,
    }.items():
        positive(name, value)
    chain = Chain(radius, beads)
    length = chain.length[0]
    rigidity = 2 * np.pi * viscosity * length**4 / frequency
    amplitude = worm_amplitude(chain, curvature)
    first, second = (
        TravellingWave(amplitude, 1.5 * np.pi / length, 1.0, phase) for phase in (0.0, np.pi / 2)
    )
    rod = ElasticRod(
        rigidity,
        twist_rigidity * rigidity,
        intrinsic_curvature=first,
        second_curvature=second,
    )
    scene = Scene(chain, viscosity, constraints=[Gears()], forces=[rod])
    tolerance = 1e-5 * float(length)
    ts = np.linspace(0.0, 30.0, 30 * SAMPLES + 1)
    return Case(
        scene,
        straight(chain, [1.0, 0.0, 0.0]),
        ts,
        until=until_periodic(tolerance),
        chunk=SAMPLES,
    )


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    # The shape is steady where it turns, so that one instant says all.
    last = solution.final
    moving = motion(solution.ts[-1], last, case.scene)
    place, velocity = np.asarray(last.position), np.asarray(moving.velocity)
    place = place - place.mean(axis=0)
    # Least squares: sum of r x v = inertia Omega.
    inertia = np.sum(place * place) * np.eye(3) - place.T @ place
    turning = np.linalg.solve(inertia, np.cross(place, velocity).sum(axis=0))
    axis = turning / np.linalg.norm(turning)
    speed = velocity.mean(axis=0) @ axis
    axis = axis if speed > 0 else -axis
    length = float(case.scene.chain.length[0])
    return {
        "speed": float(abs(speed)) / length,
        "rotation": float(np.mean(np.asarray(moving.spin), axis=0) @ axis) / (2 * np.pi),
        "shape_rotation": float(turning @ axis) / (2 * np.pi),
    }


SPIRAL = ReadyMade(
    "spiral",
    "swimmer with a helical wave: speed and rotation",
    spiral,
    {"beads": "number of beads", "frequency": "frequency as 2 pi f mu L^4/K_b"},
    _observables,
    {
        "speed": "along the axis of swimming over f L",
        "rotation": "turns of the beads about that axis in a period, on average",
        "shape_rotation": "turns of the shape about it in a period",
    },
    ("distance swum over $L$", distance_swum),
    co_moving=False,
    shown=last_period,
    quick="--beads 7 --frequency 10.0",
)
