"""Flexible fibre settling under its weight (section 3.3 of the paper), and beside a wall."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import fail, finite, kind, positive, whole
from ..chain import Chain, straight
from ..constraint import Gears
from ..dimensionless import rigidity_from_elasto_gravitational_number
from ..domain import NoSlipWall
from ..force import Bending, Contact, Weight
from ..instant import applied_load
from ..observables import deflection, friction_coefficient, orientation, rigid_resistance, tilt
from ..scene import Scene
from ..solution import Solution
from ..solver import explicit_step, substeps_for
from ..state import State
from .case import Case, ReadyMade, Value
from .models import GEARS, AbstractModel

__all__ = ["SETTLING", "SETTLING_WALL", "settling", "settling_friction", "settling_wall"]

_UP, _WALL = np.array([0.0, 1.0]), np.array([1.0, 0.0])


def settling(
    beads: int = 34,
    elasto_gravitational: float = 1000.0,
    model: AbstractModel = GEARS,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
    weight: float = 1.0,
    perturbation: float = 1e-6,
) -> Case:
    """A flexible fibre that settles along -y from a horizontal shape, until it is steady.

    Above B of about 3000 a straight start passes through a W shape which only an asymmetry can leave.
    The start therefore slopes by `perturbation` radians at one end, falling to zero at the other; a
    steady shape does not depend on it.

    **Arguments**: number of beads (at least 3); B = F L^2 / K_b, eq. (55), with F the whole weight;
    bead model (the paper compares 34 beads of Gears with 31 of Joint, equally long); a [length];
    mu; weight of a bead [force]; `perturbation` [rad].

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.settling(beads=4, elasto_gravitational=1000.0)
    >>> print([float(f.rigidity) for f in case.scene.forces if hasattr(f, "rigidity")])  # 4 * 8^2 / B
    [0.256]
    """
    whole("beads", beads, 3)
    positive("elasto_gravitational", elasto_gravitational)
    positive("weight", weight)
    finite("perturbation", perturbation)
    kind("model", model, AbstractModel)
    chain = model.chain(radius, beads)
    length = float(chain.length[0])
    rigidity = rigidity_from_elasto_gravitational_number(
        elasto_gravitational, weight * beads, length
    )
    scene = Scene(
        chain,
        viscosity,
        mobility=model.mobility,
        constraints=model.constraints(),
        forces=[
            Weight(-weight * _UP),
            *model.elasticity(chain, rigidity, drag=weight * beads),
        ],
    )
    state = model.state(chain, perturbation * np.minimum(np.arange(beads) / (beads - 2), 1) ** 2)
    relaxation = viscosity * length**4 / (100 * float(rigidity))  # of the slowest bending mode
    ts = np.linspace(0, 60 * relaxation, 1201)
    # Eq. (39) knows of bending only: a soft fibre must not fall by more than 0.2 a in a step either.
    speed = weight * beads / float(settling_friction(scene))
    step = min(float(explicit_step(scene)), 0.2 * radius / speed)
    return Case(
        scene, state, ts, substeps_for(scene, jnp.asarray(ts), step), until=_steady, chunk=10
    )


def settling_friction(scene: Scene) -> Array:
    """gamma_0, friction coefficient of the rigid straight fibre across its axis [force time/length].

    >>> from jaxbeads import scenes
    >>> gamma = scenes.settling_friction(scenes.settling(beads=4).scene)
    >>> free = scenes.settling_friction(scenes.settling(beads=4, viscosity=2.0).scene)
    >>> print(f"{free / gamma:.4f}")  # it is proportional to the viscosity
    2.0000
    """
    flat = straight(scene.chain, [1.0, 0.0]).position
    return rigid_resistance(flat, scene.chain, scene.viscosity, scene.mobility)[1, 1]


def _steady(solution: Solution) -> bool:
    """Whether the shape has hardly changed over the time of the slowest bending mode."""
    if len(solution.ts) < 61:
        return False
    position = np.asarray(solution.states.position)[-31:]
    shape = position - position.mean(axis=1, keepdims=True)
    length = np.linalg.norm(np.diff(shape[-1], axis=0), axis=1).sum()
    # A stiff fibre deflects little: its shape must settle to a part of its deflection.
    height = np.ptp(shape[-1, :, 1])
    return bool(np.abs(shape - shape[-1:]).max() < min(1e-6 * length, 1e-4 * height))


def _deflection(case: Case, solution: Solution) -> np.ndarray:
    height = deflection(solution.states.position, _UP)
    return np.asarray(height / case.scene.chain.length[0])


@eqx.filter_jit
def _measured(t: Array, final: State, scene: Scene) -> dict[str, Array]:
    force = jnp.sum(jnp.asarray(applied_load(t, final, scene).force), axis=0)
    length = scene.chain.length[0]
    return {
        "deflection": deflection(final.position, _UP) / length,
        "friction_ratio": friction_coefficient(t, final, scene, force) / settling_friction(scene),
        "tilt": tilt(final.position, _UP) / length,
    }


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    found = _measured(solution.ts[-1], solution.final, case.scene)
    return {name: float(value) for name, value in found.items()}


SETTLING = ReadyMade(
    "settling",
    "flexible fibre settling under its weight: steady deflection, friction and tilt",
    settling,
    {
        "beads": "number of beads",
        "elasto_gravitational": "B = F L^2 / K_b, eq. (55), F the weight of the fibre",
        "model": "gears, joint or spring",
    },
    _observables,
    {
        "deflection": "A/L of the last shape",
        "friction_ratio": "friction coefficient over that of the straight rigid fibre",
        "tilt": "height of the last bead over the first, over L",
    },
    ("deflection $A/L$", _deflection),
    quick="--beads 5 --elasto-gravitational 0.1",
)


def settling_wall(
    beads: int = 15,
    elasto_gravitational: float = 10.0,
    height: float = 0.5,
    angle: float = 0.3,
    *,
    fall: float = 10.0,
    radius: float = 1.0,
    viscosity: float = 1.0,
    weight: float = 1.0,
) -> Case:
    """A flexible fibre that settles along -y beside a vertical no-slip wall, x = 0.

    It starts straight, its lower end turned towards the wall (negative angles: away from it). An
    inclined rod settles along its axis, too: towards the side of its lower end. Near the wall it turns,
    its lower end away, and glances off, a rigid one at the angle at which it came (Russel, Hinch, Leal &
    Tieffenbruck, J. Fluid Mech. 83 (1977) 273); too close or too steep, it comes to lie along the
    wall, on which `Contact` holds it. Far from walls a flexible fibre turns broadside.

    **Arguments**: number of beads of a Gears chain (at least 3); B = F L^2 / K_b, eq. (55), with F the
    whole weight; distance of the centre from the wall over L, and angle from the vertical [rad], at the
    start; `fall`, the time over that in which the rigid vertical fibre far from walls settles by L; a
    [length]; mu; weight of a bead [force].

    **Raises** `ValueError` for a start behind the wall.

    >>> from jaxbeads import scenes
    >>> case = scenes.settling_wall(beads=4, height=1.0)
    >>> print(f"{case.state.position[:, 0].mean():.4f}")  # one L from the wall
    8.0000
    """
    whole("beads", beads, 3)
    positive("elasto_gravitational", elasto_gravitational)
    finite("angle", angle)
    positive("weight", weight)
    positive("fall", fall)
    chain = Chain(radius, beads)
    length, force = float(chain.length[0]), weight * beads
    least = 0.5 * abs(np.sin(angle)) * (1 - 1 / beads) + 0.5 / beads
    positive("height", height)
    if height < least:
        must = f"be at least {least:.3g}, where the fibre touches the wall"
        fail("height", must, f"it is {height:g}")
    rigidity = rigidity_from_elasto_gravitational_number(elasto_gravitational, force, length)
    scene = Scene(
        chain,
        viscosity,
        constraints=[Gears()],
        forces=[
            Weight(-weight * _UP),
            Bending(rigidity),
            Contact(force, 0.1 * radius, 0.1 * radius),
        ],
        domain=NoSlipWall(0.0 * _WALL, _WALL),
    )
    axis = np.array([-np.sin(angle), -np.cos(angle)])
    state = straight(chain, axis, height * length * _WALL)
    flat = straight(chain, [1.0, 0.0]).position
    along = float(rigid_resistance(flat, chain, viscosity)[0, 0])
    return Case(scene, state, np.linspace(0, fall * length * along / force, 401))


def _from_wall(case: Case, solution: Solution) -> np.ndarray:
    centre = np.asarray(solution.states.position)[:, :, 0].mean(axis=1)
    return centre / float(case.scene.chain.length[0])


def _beside(case: Case, solution: Solution) -> dict[str, Value]:
    position, away = solution.states.position, _from_wall(case, solution)
    turned = np.unwrap(np.asarray(orientation(position)))
    return {
        "drift": float(away[-1] - away[0]),
        "closest": float(jnp.min(position[:, :, 0]) / case.scene.chain.radius - 1),
        "tilt": float(turned[-1] - turned[0]),
    }


SETTLING_WALL = ReadyMade(
    "settling-wall",
    "flexible fibre settling beside a vertical wall: its drift, smallest gap and turning",
    settling_wall,
    {
        "beads": "number of beads",
        "elasto_gravitational": "B = F L^2 / K_b, eq. (55), F the weight of the fibre",
        "height": "distance of its centre from the wall over L",
        "angle": "angle from the vertical, lower end towards the wall [rad]",
    },
    _beside,
    {
        "drift": "displacement of the centre away from the wall over the fall, over L",
        "closest": "smallest gap between a bead's surface and the wall, over a",
        "tilt": "angle by which the fibre turns, its lower end away from the wall [rad]",
    },
    ("distance from the wall $d/L$", _from_wall),
    co_moving=True,
    quick="--beads 5 --height 1.5",
)
