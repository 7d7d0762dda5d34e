"""Filaments driven at their base, in the plane and about an axis (section 3.4 of the paper)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import positive, whole
from ..actuation import HelicalBeat, PlanarBeat
from ..chain import Chain, straight
from ..constraint import Gears, PrescribedDirection, PrescribedPosition, PrescribedSpin
from ..dimensionless import rigidity_from_sperm_number
from ..force import Bending
from ..geometry import norm
from ..objectives import thrust
from ..observables import rigid_resistance
from ..scene import Scene
from ..solution import Solution
from ..state import State
from .case import SAMPLES, Case, ReadyMade, Value, last_period, until_periodic

__all__ = [
    "HELICAL_BEATING",
    "PLANAR_BEATING",
    "helical_beating",
    "lateral_harmonic",
    "planar_beating",
]

_FREQUENCY = 1.0  # zeta; the unit of time
_MOST_PERIODS = 200
_thrust = eqx.filter_jit(thrust)


def _normal_friction(chain: Chain, viscosity: float) -> Array:
    flat = straight(chain, [1.0, 0.0]).position
    return rigid_resistance(flat, chain, viscosity)[1, 1]


def _case(scene: Scene, state: State, amplitude: float) -> Case:
    period = 2 * np.pi / _FREQUENCY
    ts = np.linspace(0, _MOST_PERIODS * period, _MOST_PERIODS * SAMPLES + 1)
    tolerance = 2e-5 * amplitude * float(scene.chain.length[0])
    return Case(
        scene,
        state,
        ts,
        tolerance=2e-6 * amplitude,  # a tenth of what counts as periodic
        until=until_periodic(tolerance),
        chunk=SAMPLES,
        scales={"amplitude": amplitude},
    )


def planar_beating(
    beads: int = 20,
    sperm_number: float = 2.2,
    *,
    amplitude: float = 0.435,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """A Gears filament whose base angle oscillates in the plane, alpha_0 sin(zeta t), eqs
    (59)-(61), until the beat is periodic.

    The first bead is held, without spin; the direction of the first bond is prescribed. zeta = 1.

    **Arguments**: number of beads (at least 4); sperm number Sp, eq. (58), with gamma the normal
    friction of the rigid straight chain; alpha_0 [rad]; a [length]; mu.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import dynamics, scenes
    >>> for constraint in scenes.planar_beating(beads=4).scene.constraints:
    ...     print(dynamics.named(constraint))
    Gears
    PrescribedPosition(bead=0)
    PrescribedSpin(bead=0)
    PrescribedDirection(bond=0)
    """
    whole("beads", beads, 4)
    positive("sperm_number", sperm_number)
    positive("amplitude", amplitude)
    chain = Chain(radius, beads)
    friction = _normal_friction(chain, viscosity)
    rigidity = rigidity_from_sperm_number(sperm_number, chain.length[0], _FREQUENCY, friction)
    constraints = (
        Gears(),
        PrescribedPosition(),
        PrescribedSpin(),
        PrescribedDirection(PlanarBeat(amplitude, _FREQUENCY)),
    )
    scene = Scene(chain, viscosity, constraints=constraints, forces=[Bending(rigidity)])
    first_bead_at_origin = [radius * (beads - 1), 0.0]
    state = straight(chain, [1.0, 0.0], first_bead_at_origin)
    return _case(scene, state, amplitude)


def lateral_harmonic(solution: Solution, fractions: np.ndarray) -> np.ndarray:
    """First harmonic of the lateral deflection over the last period, y = Im(c exp(i zeta t)): complex c
    [length] at fractions of the distance between the first and the last bead's centres.

    >>> import jax, jax.numpy as jnp, numpy as np
    >>> import jaxbeads as jb
    >>> ts = jnp.linspace(0.0, 2 * jnp.pi, 41)
    >>> tip = jnp.stack([jnp.full(41, 2.0), 0.1 * jnp.sin(ts)], axis=1)  # c = 0.1
    >>> states = jax.vmap(jb.State)(jnp.stack([jnp.zeros((41, 2)), tip], axis=1))
    >>> run = jb.Solution(ts, states, jnp.array(40), jnp.array(0))
    >>> print(abs(jb.scenes.lateral_harmonic(run, np.array([0.5, 1.0]))).round(4))
    [0.05 0.1 ]
    """
    period = last_period(solution)
    ts = np.asarray(period.ts)
    y = np.asarray(period.states.position)[
        :-1, :, 1
    ]  # the last time is the first of the next period
    beads = y.shape[1]
    at = fractions * (beads - 1)
    y = np.stack([np.interp(at, np.arange(beads), row) for row in y])
    return 2j * np.mean(y * np.exp(-1j * _FREQUENCY * ts[:-1])[:, None], axis=0)


def _planar(case: Case, solution: Solution) -> dict[str, Value]:
    scene = case.scene
    chain, alpha = scene.chain, case.scales["amplitude"]
    length = float(chain.length[0])
    c = lateral_harmonic(solution, np.array([0.25, 0.5, 0.75, 1.0]))
    scale = _normal_friction(chain, float(scene.viscosity)) / length * _FREQUENCY
    # Against the direction in which the filament extends from its holder.
    push = _thrust(last_period(solution), scene, jnp.array([-1.0, 0.0]))
    return {
        "amplitude": [float(x) for x in np.abs(c) / (alpha * length)],
        "tip_phase": float(np.angle(c[-1])),
        "thrust": float(push / (scale * (alpha * length) ** 2)),
    }


def _tip_height(case: Case, solution: Solution) -> np.ndarray:
    return np.asarray(solution.states.position[:, -1, 1] / case.scene.chain.length[0])


PLANAR_BEATING = ReadyMade(
    "planar-beating",
    "filament with an oscillating base: amplitudes along it, phase of its tip, thrust",
    planar_beating,
    {"beads": "number of beads", "sperm_number": "sperm number Sp, eq. (58)"},
    _planar,
    {
        "amplitude": "lateral amplitudes at L/4, L/2, 3L/4 and L over alpha_0 L",
        "tip_phase": "phase of the tip's lateral position [rad]",
        "thrust": "mean force on the holder over (gamma/L) omega (alpha_0 L)^2",
    },
    ("lateral position of the tip $y/L$", _tip_height),
    co_moving=False,
    quick="--beads 5 --sperm-number 1.5",
)


def helical_beating(
    beads: int = 10,
    sperm_number: float = 2.2,
    *,
    amplitude: float = 0.262,
    anchor: float = 2.7,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """A Gears filament whose base circles about the x axis at the cone angle alpha_0, eqs
    (62)-(64), until the motion is steady.

    The first bead is at delta d(t), the first bond along d(t), eq. (62); the first bead does not spin.
    zeta = 1.

    **Arguments**: number of beads (at least 4); sperm number, as for `planar_beating`; alpha_0 [rad];
    delta over a; a [length]; mu.

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.helical_beating(beads=4)
    >>> print(case.state.position.shape, len(case.scene.constraints))
    (4, 3) 4
    """
    whole("beads", beads, 4)
    positive("sperm_number", sperm_number)
    positive("amplitude", amplitude)
    positive("anchor", anchor)
    chain = Chain(radius, beads)
    friction = _normal_friction(chain, viscosity)
    rigidity = rigidity_from_sperm_number(sperm_number, chain.length[0], _FREQUENCY, friction)
    direction = HelicalBeat(amplitude, _FREQUENCY)
    constraints = (
        Gears(),
        PrescribedPosition(HelicalBeat(amplitude, _FREQUENCY, anchor * radius)),
        PrescribedSpin(),
        PrescribedDirection(direction),
    )
    scene = Scene(chain, viscosity, constraints=constraints, forces=[Bending(rigidity)])
    start = direction(jnp.zeros(()))
    state = straight(chain, start, (anchor + beads - 1) * radius * start)
    return _case(scene, state, amplitude)


def _tip_distance(case: Case, solution: Solution) -> np.ndarray:
    tip = solution.states.position[:, -1, 1:]
    return np.asarray(norm(tip) / case.scene.chain.length[0])


def _helical(case: Case, solution: Solution) -> dict[str, Value]:
    return {"tip_distance": float(np.mean(_tip_distance(case, solution)[-SAMPLES:]))}


HELICAL_BEATING = ReadyMade(
    "helical-beating",
    "filament with a circling base: distance of its tip from the axis",
    helical_beating,
    {"beads": "number of beads", "sperm_number": "sperm number Sp, eq. (58)"},
    _helical,
    {
        "tip_distance": "mean distance of the tip from the axis over L",
    },
    ("distance of the tip from the axis $d/L$", _tip_distance),
    co_moving=False,
    shown=last_period,
    quick="--beads 5 --sperm-number 1.5",
)
