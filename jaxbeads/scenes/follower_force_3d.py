"""Clamped filament under a follower force in space: whirling or planar flapping."""

import numpy as np

from .._checks import finite, positive, whole
from ..chain import Chain, from_tangents, straight
from ..constraint import Gears, clamped
from ..force import Bending, Follower
from ..mobility import AbstractMobility, FreeDraining
from ..scene import Scene
from ..solution import Solution
from ..state import State
from .case import Case, ReadyMade, Value, modes, tip_radii, whirl

__all__ = ["FOLLOWER_FORCE_3D", "follower_force_3d"]

_LOCAL = FreeDraining()
_PERIODS = 10
"""Late times that count, as a part of the run: one in so many."""


def follower_force_3d(
    beads: int = 16,
    force: float = 45.0,
    *,
    flatness: float = 0.05,
    mobility: AbstractMobility = _LOCAL,
    radius: float = 1.0,
    viscosity: float = 1.0,
    rigidity: float = 1.0,
    perturbation: float = 0.05,
) -> Case:
    """A Gears filament in space, clamped at its first bond, with a compressive force along its tip.

    At P L^2/K_b = 37.695 (slender, local drag) both transverse modes turn unstable together: any plane
    may flap, and two planes a quarter of a period apart whirl. Just above, whirling is stable and
    flapping in a plane is not: at 40, 45 and 60, with 16 beads, flapping turns to whirling at the rates
    15.3, 37.3 and 89.0 K_b/(xi_perp L^4), and whirling comes back to itself at 20.1, 40.9 and 74.4. So
    it is, with 12 beads, up to 170; at 200 flapping is stable, and what starts to whirl ends in a plane.
    It starts with a bend in one plane and a small one in the other, and is followed until one of both
    has won.

    **Arguments**: number of beads (at least 5); force as P L^2/K_b, L being the length beyond the clamp,
    2 a (N - 1); slope of the bend in the second plane over that in the first (0: it stays planar);
    mobility; a [length]; mu; K_b; slope of the bend [rad].

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.follower_force_3d(beads=5, force=64.0)
    >>> print(case.state.position.shape, case.scene.forces[1].force)  # 64 K_b/L^2, L = 8
    (5, 3) 1.0
    """
    whole("beads", beads, 5)
    finite("force", force)
    finite("flatness", flatness)
    positive("rigidity", rigidity)
    positive("perturbation", perturbation)
    chain = Chain(radius, beads)
    length = 2 * radius * (beads - 1)
    push = Follower(force * rigidity / length**2)
    forces = [Bending(rigidity), push]
    scene = Scene(chain, viscosity, mobility, [Gears(), *clamped()], forces)
    s = np.linspace(0, 1, beads - 1)
    e = np.stack([1 + 0 * s, perturbation * s**2, perturbation * flatness * s], axis=1)
    position = np.asarray(from_tangents(chain, e))
    unit = 3 * np.pi * viscosity * length**4 / rigidity
    growth = max(abs(float(np.real(_growth(scene)))) * unit, 1.0)
    # As long as the slow exchange between the planes takes.
    span = min(60.0 / growth, 8.0)
    samples = int(400 * span)
    scales = {"rigidity": rigidity, "length": length}
    state = State(position - position[0])
    return Case(scene, state, np.linspace(0, span * unit, samples + 1), scales=scales)


def _growth(scene: Scene) -> complex:
    return modes(scene, straight(scene.chain, [1.0, 0.0, 0.0]))[0]


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    scene, length = case.scene, case.scales["length"]
    unit = 3 * np.pi * float(scene.viscosity) * length**4 / case.scales["rigidity"]
    late = slice(-len(solution.ts) // _PERIODS, None)
    place = np.asarray(solution.states.position)[late, -1, 1:]
    radii, ts = tip_radii(solution)[late], np.asarray(solution.ts)[late]
    developed = bool(radii.max() > 0.02 * length)
    # A tip that flaps in a plane passes the axis; one that whirls stays off it.
    whirls = bool(developed and radii.min() > 0.5 * radii.max())
    if whirls:
        rate = abs(whirl(solution, scene)[1])
    else:
        along = place @ np.linalg.svd(place)[2][0]
        passed = ts[1:][along[1:] * along[:-1] < 0]
        rate = np.pi * (len(passed) - 1) / np.ptp(passed) if len(passed) > 1 else 0.0
    return {
        "growth_rate": float(np.real(_growth(scene))) * unit,
        "whirls": whirls,
        "frequency": float(rate) * unit,
        "tip_radius": float(radii.max()) / length,
    }


FOLLOWER_FORCE_3D = ReadyMade(
    "follower-force-3d",
    "clamped filament under a follower force in space: whirling or flapping",
    follower_force_3d,
    {"beads": "number of beads", "force": "force as P L^2/K_b"},
    _observables,
    {
        "growth_rate": "of the fastest deflection from straight over K_b/(xi_perp L^4)",
        "whirls": "whether the tip goes around the axis; else it flaps, or comes to rest",
        "frequency": "angular frequency of the tip over K_b/(xi_perp L^4), 0 at rest",
        "tip_radius": "largest distance of the tip from the axis over L, at the end",
    },
    (
        "distance of the tip from the axis over $L$",
        lambda case, run: tip_radii(run) / case.scales["length"],
    ),
    co_moving=False,
    quick="--beads 6 --force 60.0",
)
