"""A rod that is turned about its axis at one end: twist, and whirling."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import fail, positive, whole
from ..chain import Chain, from_tangents, straight
from ..constraint import Gears, PrescribedRoll, clamped
from ..force import ElasticRod
from ..material import with_frames
from ..mobility import AbstractMobility, FreeDraining
from ..scene import Scene
from ..solution import Solution
from ..state import Load, State
from .case import Case, ReadyMade, Value, modes, settled, tip_radii, whirl

__all__ = ["WHIRLING", "whirling"]

_LOCAL = FreeDraining()
_CRITICAL = 8.8651
"""omega_c xi_r L^2/K_b with local drag."""
_CHUNK = 10
"""Save times between two looks at whether a run has settled."""


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

    Below a critical rate it turns on its axis, straight and twisted by its drag (local:
    tau = omega xi_r (L - s)/K_t); above it whirls: its bent shape goes around the axis. It starts
    straight and twisted like that but for a small bend, and is followed until a growing bend is fully
    developed.

    The critical rate is that of a slender rod with local drag, 8.8651 K_b/(xi_r L^2), L being the length
    beyond the clamp, 2 a (N - 1), and xi_r = 4 pi mu a^2; 8, 16 and 32 beads have 9.757, 9.038, 8.905,
    and go around with 27.44, 23.71, 23.04 K_b/(xi_perp L^4) there. With `RPY()` beads drag one another
    along, and whirl from 9.747, 9.451, 9.420 on, with 39.62, 44.88, 53.60. What whirls far above folds
    back along its axis; beads do not keep one another off.

    **Arguments**: number of beads (at least 5); the rate over the critical one; K_t/K_b; mobility; a
    [length]; mu; K_b; slope of the start's bend [rad].

    **Raises** `ValueError` for too few beads, numbers that are out of range, and rates at which a bond
    would twist by more than half a turn.

    >>> from jaxbeads import scenes
    >>> case = scenes.whirling(beads=5, rate=0.5)
    >>> roll = case.scene.constraints[-1]
    >>> print(f"{roll.law * 4 * 3.14159265 * 8**2:.3f}")  # half of 8.8651 K_b/(xi_r L^2)
    4.433
    """
    whole("beads", beads, 5)
    for name, value in {
        "rate": rate,
        "twist_rigidity": twist_rigidity,
        "rigidity": rigidity,
        "perturbation": perturbation,
    }.items():
        positive(name, value)
    chain = Chain(radius, beads)
    length = 2 * radius * (beads - 1)
    omega = rate * _CRITICAL * rigidity / (4 * np.pi * viscosity * radius**2 * length**2)
    rod = ElasticRod(rigidity, twist_rigidity * rigidity)
    roll = np.asarray(omega)
    scene = Scene(chain, viscosity, mobility, [Gears(), *clamped(roll=roll)], [rod])
    turned = np.abs(_twist(scene)).max() * 2 * radius
    if turned >= np.pi:
        most = rate * np.pi / turned
        fail("rate", f"be below {most:.3g}, where a bond twists by half a turn", f"it is {rate:g}")
    slope = perturbation * np.linspace(0, 1, beads - 1) ** 2
    e = np.stack([np.cos(slope), np.sin(slope), 0 * slope], axis=1)
    position = np.asarray(from_tangents(chain, e))
    state = with_frames(State(position - position[0]), chain, [0.0, 0.0, 1.0], _twist(scene))
    unit = 3 * np.pi * viscosity * length**4 / rigidity
    growth = abs(float(np.real(_growth(scene)))) * unit
    span = min(4 * np.log(1 / perturbation) / max(growth, 1e-9), 40.0) + 1.0
    samples = int(200 * span)
    ts = np.linspace(0, samples / 200 * unit, samples + 1)
    scales = {"rigidity": rigidity, "length": length}
    return Case(scene, state, ts, until=settled(length), chunk=_CHUNK, scales=scales)


def _twist(scene: Scene) -> np.ndarray:
    """That of the straight rod: each bond bears the drag of the beads beyond it."""
    rod, roll = scene.forces[0], scene.constraints[-1]
    if not isinstance(rod, ElasticRod) or not isinstance(roll, PrescribedRoll):
        fail("scene", "be that of `whirling`", "it holds other terms")
    beyond = np.cumsum(np.asarray(_drags(scene))[:0:-1])[::-1]
    return -float(roll.law) * beyond / float(rod.twist_rigidity)


@eqx.filter_jit
def _drags(scene: Scene) -> Array:
    """Torque of each bead of the straight rod over the rate at which all turn about it."""
    beads, axis = scene.chain.beads, jnp.eye(1, 3)
    spheres = scene.configuration(straight(scene.chain, [1.0, 0.0, 0.0]), True)

    def spin(torque: Array) -> Array:
        load = Load(jnp.zeros((beads, 3)), torque[:, None] * axis)
        moved: Any = scene.mobility.motion(spheres, load)
        return moved.spin[:, 0]

    return jnp.linalg.solve(jax.jacfwd(spin)(jnp.zeros(beads)), jnp.ones(beads))


def _growth(scene: Scene) -> complex:
    """Rate at which the fastest bend of the straight, twisted rod grows [1/time]; its imaginary part is
    the rate at which it goes around.
    """
    state = straight(scene.chain, [1.0, 0.0, 0.0])
    return modes(scene, with_frames(state, scene.chain, twist=_twist(scene)))[0]


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    scene, length = case.scene, case.scales["length"]
    unit = 3 * np.pi * float(scene.viscosity) * length**4 / case.scales["rigidity"]
    radius, rate = whirl(solution, scene)
    away = np.linalg.norm(np.asarray(solution.final.position)[:, 1:], axis=1).max()
    return {
        "growth_rate": float(np.real(_growth(scene))) * unit,
        "whirls": bool(away > 0.05 * length),
        "tip_radius": radius / length,
        "frequency": abs(rate) * unit,
    }


WHIRLING = ReadyMade(
    "whirling",
    "clamped rod that is turned about its axis: growth rate over K_b/(xi_perp L^4), whirling",
    whirling,
    {"beads": "number of beads", "rate": "rate of turning over the critical one"},
    _observables,
    {
        "growth_rate": "of the fastest bend of the straight twisted rod over K_b/(xi_perp L^4)",
        "whirls": "whether its shape goes around the axis, bent",
        "tip_radius": "distance of the tip from the axis over L, at the end",
        "frequency": "rate at which the tip goes around then, over K_b/(xi_perp L^4)",
    },
    (
        "distance of the tip from the axis over $L$",
        lambda case, run: tip_radii(run) / case.scales["length"],
    ),
    co_moving=False,
    quick="--beads 6 --rate 0.8",
)
