"""A straight rod with curvature and twist at rest, which coils up to a helix."""

import numpy as np

from .._checks import fail, finite, positive, whole
from ..chain import Chain, straight
from ..constraint import Gears
from ..force import ElasticRod
from ..geometry import bonds
from ..material import with_frames
from ..mobility import AbstractMobility, FreeDraining
from ..scene import Scene
from ..solution import Solution
from .case import Case, ReadyMade, Value

__all__ = ["HELIX_FORMATION", "helix_formation"]

_LOCAL = FreeDraining()


def helix_formation(
    beads: int = 24,
    curvature: float = 3.0,
    twist: float = 4.0,
    *,
    twist_rigidity: float = 1.0,
    mobility: AbstractMobility = _LOCAL,
    radius: float = 1.0,
    viscosity: float = 1.0,
    rigidity: float = 1.0,
) -> Case:
    """A free Gears rod whose shape at rest has the curvature kappa_0 about d_1 and the twist tau_0, from
    straight and twisted until its energy is gone: a helix of radius kappa_0/(kappa_0^2 + tau_0^2) and
    pitch 2 pi tau_0/(kappa_0^2 + tau_0^2).

    **Arguments**: number of beads (at least 6); kappa_0 L and tau_0 L, L = 2 a N; K_t/K_b; mobility
    (no matter to the shape at rest); a [length]; mu; K_b.

    **Raises** `ValueError` for too few beads, numbers that are out of range, and a shape at rest that
    turns by more than a radian from bead to bead.

    >>> from jaxbeads import scenes
    >>> rod = scenes.helix_formation(beads=6, curvature=2.4, twist=1.2).scene.forces[0]
    >>> print(f"{rod.intrinsic_curvature:.4f} {rod.intrinsic_twist:.4f}")  # over L = 12
    0.2000 0.1000
    """
    whole("beads", beads, 6)
    positive("curvature", curvature)
    finite("twist", twist)
    positive("twist_rigidity", twist_rigidity)
    positive("rigidity", rigidity)
    for name, value in {"curvature": curvature, "twist": twist}.items():
        if abs(value) > beads:
            how = f"a joint turns by {abs(value) / beads:.3g} radians"
            fail(name, "be resolved by the beads, at most their number", f"{how} of it")
    chain = Chain(radius, beads)
    length = float(chain.length[0])
    bend, turn = curvature / length, twist / length
    rod = ElasticRod(
        rigidity, twist_rigidity * rigidity, intrinsic_curvature=bend, intrinsic_twist=turn
    )
    scene = Scene(chain, viscosity, mobility, [Gears()], [rod])
    state = with_frames(straight(chain, [1.0, 0.0, 0.0]), chain, [0.0, 0.0, 1.0], turn)
    unit = viscosity * length**4 / rigidity
    return Case(scene, state, np.linspace(0.0, 2.0 * unit, 101))


def _angles(solution: Solution) -> np.ndarray:
    """Angle between the first and the last bond at each time, over pi."""
    d = np.asarray(bonds(solution.states.position))
    e = d / np.linalg.norm(d, axis=2, keepdims=True)
    return np.arccos(np.clip(np.sum(e[:, 0] * e[:, -1], axis=1), -1, 1)) / np.pi


def _helix(position: np.ndarray) -> tuple[float, float]:
    """Radius and pitch of the helix through the beads, from how successive bonds turn and step: means
    along the fibre.
    """
    d = np.diff(position, axis=0)
    axis = np.cross(np.diff(d, axis=0)[:-1], np.diff(d, axis=0)[1:]).sum(axis=0)
    axis /= np.linalg.norm(axis)
    rise = d @ axis
    across = d - np.outer(rise, axis)
    turn = np.arctan2(
        np.cross(across[:-1], across[1:]) @ axis, np.sum(across[:-1] * across[1:], axis=1)
    ).mean()
    radius = np.linalg.norm(across, axis=1).mean() / (2 * np.sin(turn / 2))
    return float(radius), float(2 * np.pi * rise.mean() / turn)


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    radius, pitch = _helix(np.asarray(solution.final.position))
    length = float(case.scene.chain.length[0])
    return {"radius": radius / length, "pitch": pitch / length}


HELIX_FORMATION = ReadyMade(
    "helix-formation",
    "rod that coils up to the helix of its curvature and twist at rest: radius and pitch over L",
    helix_formation,
    {
        "beads": "number of beads",
        "curvature": "curvature at rest as kappa_0 L",
        "twist": "twist at rest as tau_0 L",
    },
    _observables,
    {
        "radius": "of the shape at rest over L: kappa_0/(kappa_0^2 + tau_0^2) for a slender rod",
        "pitch": "over L, positive right-handed: 2 pi tau_0/(kappa_0^2 + tau_0^2)",
    },
    ("angle between the ends over pi", lambda case, run: _angles(run)),
    quick="--beads 8 --curvature 3.0 --twist 2.0",
)
