"""A rod that is turned about its axis at one end: twist, and whirling."""

import numpy as np

from .._checks import positive, whole
from ..chain import Chain, from_tangents, straight
from ..constraint import Gears, clamped
from ..force import ElasticRod
from ..material import with_frames
from ..mobility import FreeDraining
from ..mobility import AbstractMobility
from ..scene import Scene
from ..solution import Solution
from ..state import State
from .case import Case, ReadyMade, Value, modes, whirl

__all__ = ["WHIRLING", "whirling"]

_LOCAL = FreeDraining()
_CRITICAL = 8.8651
"""omega_c xi_r L^2/K_b with local drag."""


def whirling(
    beads: int = 16,
    rate: float = 1.2,
    *,
    twist_rigidity: float = 1.0,
    mobility: AbstractMobility = _LOCAL,
    radius: float = 1.0,
    viscosity: float = 1.0,
    rigidity: float = 1.0,
    perturbation: float = 1e-2,
) -> Case:
    """A Gears rod, clamped at its first bond and turned about it at a rate; its other end is free.

    Below a critical rate it turns on its axis, straight and twisted by its drag,
    tau = omega xi_r (L - s)/K_t; above it whirls: its bent shape goes around the axis. It starts
    straight and twisted like that but for a small bend, and is followed until a growing bend is fully
    developed.

    The critical rate is that of a slender rod with local drag, 8.8651 K_b/(xi_r L^2), L being the length
    beyond the clamp, 2 a (N - 1), and xi_r = 4 pi mu a^2. With `RPY()` beads drag one another along, and
    it starts to whirl elsewhere.

    **Arguments**: number of beads (at least 5); the rate over the critical one; K_t/K_b; mobility; a
    [length]; mu; K_b; slope of the start's bend [rad].

    **Raises** `ValueError` for too few beads, numbers that are out of range, and rates at which a bond
    would twist by more than half a turn.

    >>> from jaxbeads import scenes
    >>> case = scenes.whirling(beads=5, rate=0.5)
    >>> roll = case.scene.constraints[-1]
    >>> print(f"{roll.law * 4 * 3.14159265 * 8**2:.4f}")  # half of 8.8651 K_b/(xi_r L^2)
    4.4326
    """
