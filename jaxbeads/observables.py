"""What is measured on states, trajectories and scenes.

Functions of positions take any leading axes (times); pass `solution.states.position`. Those of a state
are of one state; over time by `jax.vmap(lambda t, s: tension(t, s, scene))(sol.ts, sol.states)`. Those
of loads (who exerts which, tension, moments, energy) are written in `loads`.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import fail
from ._typing import float_array
from .chain import Chain, straight
from .configuration import Configuration
from .domain import NoSlipWall
from .dynamics import constraint_residual, evaluate, motion
from .geometry import bonds, cross, norm, tangents
from .images import wall
from .instant import Time
from .loads import (
    bending_moment,
    constraint_loads,
    drag,
    elastic_energy,
    handed_on,
    holding_load,
    load_on_fluid,
    net_load,
    shear_force,
    stress_resultants,
    tension,
)
from .mobility import RPY, AbstractMobility
from .scene import Scene
from .state import Load, Motion, State, spins

__all__ = [
    "bending_moment",
    "bond_length_error",
    "constraint_loads",
    "constraint_residual",
    "curvature",
    "deflection",
    "drag",
    "elastic_energy",
    "end_to_end_distance",
    "friction_coefficient",
    "holding_load",
    "load_on_fluid",
    "minimal_radius_of_curvature",
    "net_load",
    "orbit_period",
    "orientation",
    "power",
    "pumping_rate",
    "rigid_resistance",
    "settling_velocity",
    "shear_force",
    "stress_resultants",
    "swimming_efficiency",
    "tension",
    "tilt",
    "wall_force",
]


_RPY = RPY()


def curvature(position: Float[Array, "*times beads dim"], chain: Chain) -> Array:
    """Curvature |e x e'| / l at each inner bead, eq. (34), shape `(*times, beads - 2)` [1/length].

    Signed in the plane (anticlockwise positive); zero where one fibre ends and the next begins.

    >>> import jaxbeads as jb
    >>> from jaxbeads.observables import curvature
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> print(curvature(jb.from_tangents(chain, [[1.0, 0.0], [0.8, 0.6]]), chain).round(6))  # 0.6/2
    [0.3]
    """
    e = tangents(position)
    sine = cross(e[..., :-1, :], e[..., 1:, :])
    sine = sine[..., 0] if position.shape[-1] == 2 else norm(sine)
    length = 0.5 * (chain.bond_length[1:] + chain.bond_length[:-1])
    return sine * jnp.broadcast_to(chain.joint_mask / length, sine.shape)


def minimal_radius_of_curvature(
    position: Float[Array, "*times beads dim"], chain: Chain
) -> Float[Array, "*times"]:
    """Smallest radius of curvature along the fibres [length]; infinite when straight, or where no fibre
    has three beads.

    >>> import jaxbeads as jb
    >>> from jaxbeads.observables import minimal_radius_of_curvature
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> bent = jb.from_tangents(chain, [[1.0, 0.0], [0.8, 0.6]])
    >>> print(f"{minimal_radius_of_curvature(bent, chain):.4f}")
    3.3333
    """
    largest = jnp.max(jnp.abs(curvature(position, chain)), axis=-1, initial=0.0)
    return jnp.where(largest == 0, jnp.inf, 1 / jnp.where(largest == 0, 1.0, largest))


def _ends(position: Array, chain: Chain | None) -> Array:
    """Vectors from first beads to last ones: of each fibre, or of all beads as one fibre."""
    if chain is None:
        return position[..., -1, :] - position[..., 0, :]
    last = np.cumsum(chain.fibres) - 1
    return position[..., last, :] - position[..., last + 1 - np.array(chain.fibres), :]


def end_to_end_distance(
    position: Float[Array, "*times beads dim"], chain: Chain | None = None
) -> Float[Array, "*values"]:
    """Distance of the first and the last bead's centres [length]: of each fibre of the `chain`, shape
    `(*times, fibres)`, or, without one, of all beads taken as one fibre, `times`.

    >>> import jax.numpy as jnp, jaxbeads as jb
    >>> from jaxbeads.observables import end_to_end_distance
    >>> position = jnp.array([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0], [2.0, 3.0]])
    >>> print(f"{end_to_end_distance(position):.4f}")
    3.6056
    >>> print(end_to_end_distance(position, jb.Chain(radius=1.0, fibres=[2, 2])))
    [2. 2.]
    """
    return norm(_ends(position, chain))


def deflection(
    position: Float[Array, "*times beads dim"], direction: Any
) -> Float[Array, "*times"]:
    """Distance of the extreme centres of all beads along `direction` (A of the settling fibre)
    [length].

    >>> import jax.numpy as jnp
    >>> from jaxbeads.observables import deflection
    >>> print(deflection(jnp.array([[0.0, 0.5], [2.0, -1.0], [4.0, 0.5]]), [0.0, 1.0]))
    1.5
    """
    unit = jnp.asarray(direction) / jnp.linalg.norm(jnp.asarray(direction))
    height = position @ unit
    return jnp.max(height, axis=-1) - jnp.min(height, axis=-1)


def tilt(
    position: Float[Array, "*times beads dim"], direction: Any, chain: Chain | None = None
) -> Float[Array, "*values"]:
    """How much further the last bead is along `direction` than the first [length]; `chain` as for
    `end_to_end_distance`.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.observables import tilt
    >>> print(tilt(jnp.array([[0.0, 0.5], [2.0, -1.0], [4.0, 1.0]]), [0.0, 1.0]))
    0.5
    """
    unit = jnp.asarray(direction) / jnp.linalg.norm(jnp.asarray(direction))
    return _ends(position, chain) @ unit


def orientation(
    position: Float[Array, "*times beads dim"], chain: Chain | None = None
) -> Float[Array, "*values"]:
    """Angle of the end-to-end vector in the x-y plane, from x [rad], in (-pi, pi]; `chain` as for
    `end_to_end_distance`.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.observables import orientation
    >>> print(f"{orientation(jnp.array([[0.0, 0.0], [1.0, 1.0]])):.4f}")  # 45 degrees
    0.7854
    """
    ends = _ends(position, chain)
    return jnp.arctan2(ends[..., 1], ends[..., 0])


def orbit_period(ts: Any, position: Any) -> float:
    """Period of rotation in the x-y plane of the vector from the first bead of all to the last: twice
    the time of the first half turn [time].

    Cubic interpolation between saved times. A host function (not for `jit`).

    **Raises** `ValueError` if the trajectory holds less than half a turn.

    >>> import numpy as np
    >>> from jaxbeads.observables import orbit_period
    >>> ts = np.linspace(0.0, 5.0, 21)
    >>> ends = np.stack([np.cos(ts), np.sin(ts)], axis=1)
    >>> print(round(orbit_period(ts, np.stack([-ends, ends], axis=1)), 6))  # 2 pi
    6.283185
    """
    ts, angle = np.asarray(ts), np.unwrap(np.asarray(orientation(jnp.asarray(position))))
    turned = np.abs(angle - angle[0])
    if len(ts) < 4 or turned[-1] < np.pi:
        fail("position", "hold at least half a turn", f"it turns by {turned[-1]:.3g} rad only")
    at = int(np.clip(np.argmax(turned >= np.pi) - 2, 0, len(ts) - 4))
    near = slice(at, at + 4)
    # Inverse interpolation: time as the cubic in the angle through four neighbours.
    t, x = ts[near], turned[near]
    half = sum(
        t[i] * np.prod([(np.pi - x[j]) / (x[i] - x[j]) for j in range(4) if j != i])
        for i in range(4)
    )
    return float(2 * (half - ts[0]))


def bond_length_error(
    position: Float[Array, "*times beads dim"], chain: Chain
) -> Float[Array, "*times bonds"]:
    """Relative error of each bond length, `(*times, beads - 1)`; zero between fibres.

    >>> import jax.numpy as jnp, jaxbeads as jb
    >>> from jaxbeads.observables import bond_length_error
    >>> position = jnp.array([[0.0, 0.0], [2.0, 0.0], [4.02, 0.0]])
    >>> print(bond_length_error(position, jb.Chain(radius=1.0, fibres=3)).round(6))
    [0.   0.01]
    """
    length = norm(bonds(position))
    error = length / jnp.broadcast_to(chain.bond_length, length.shape) - 1
    return error * jnp.broadcast_to(chain.bond_mask, length.shape)


def settling_velocity(t: Time, state: State, scene: Scene) -> Float[Array, " dim"]:
    """Mean velocity of the beads at one instant [length/time].

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> print(jb.observables.settling_velocity(0.0, jb.State([[0.0, 0.0]]), scene).round(4))  # 1/pi
    [ 0.     -0.3183]
    """
    return jnp.mean(motion(t, state, scene).velocity, axis=0)


def friction_coefficient(t: Time, state: State, scene: Scene, force: Any) -> Float[Array, ""]:
    """gamma = F / V for the total force F [force time/length], V the mean velocity along F.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> gamma = jb.observables.friction_coefficient(0.0, jb.State([[0.0, 0.0]]), scene, [0.0, -6.0])
    >>> print(f"{gamma:.4f}")  # 6 pi mu a
    18.8496
    """
    force = jnp.asarray(force)
    size = jnp.max(jnp.abs(force))  # a square of the force itself may be too small
    size = size * jnp.linalg.norm(force / jnp.where(size == 0, 1.0, size))
    return size / jnp.dot(settling_velocity(t, state, scene), force / size)


def power(t: Time, state: State, scene: Scene) -> Float[Array, ""]:
    """Work done on the fluid per time by all forces and torques, of the scene's terms and of its
    constraints: sum of F.v + T.w [force length/time]. In a quiescent fluid it is the dissipation.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> print(f"{jb.observables.power(0.0, jb.State([[0.0, 0.0]]), scene):.4f}")  # F^2/(6 pi mu a)
    1.9099
    """
    found = evaluate(t, state, scene)
    moved, load = found.motion, handed_on(t, state, scene, found)
    done = jnp.zeros((), state.position.dtype)
    if load.force is not None:
        done = done + jnp.sum(load.force * moved.velocity)
    if load.torque is not None and moved.spin is not None:
        done = done + jnp.sum(load.torque * moved.spin)
    return done


def pumping_rate(t: Time, state: State, scene: Scene, along: Any) -> Float[Array, ""]:
    """Volume of fluid that the beads drive along a no-slip wall per time, through any plane across it
    [length^3/time]: Q = sum of (F.d h + T.(n x d)/2) / (pi mu), for forces F at heights h, torques T,
    and the wall's normal n.

    **Arguments**: time, state and scene; `along`, the direction d on the wall, of any length. The
    ambient flow does not count. **Raises** `ValueError` if the domain is no `NoSlipWall`.

    >>> import jaxbeads as jb
    >>> push, wall = jb.force.Weight([2.0, 0.0]), jb.NoSlipWall([0.0, 0.0], [0.0, 1.0])
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[push], domain=wall)
    >>> rate = jb.observables.pumping_rate(0.0, jb.State([[0.0, 3.0]]), scene, [1.0, 0.0])
    >>> print(f"{rate:.4f}")  # F h/(pi mu)
    1.9099
    """
    if not isinstance(scene.domain, NoSlipWall):
        fail("scene.domain", "be a NoSlipWall", f"it is {type(scene.domain).__name__}")
    load, above = load_on_fluid(t, state, scene), wall(scene.configuration(state, scene.rotational))
    n = scene.domain.direction
    d = float_array(along)
    d = d - jnp.dot(d, n) * n
    d = d / jnp.sqrt(jnp.dot(d, d))
    pushed = jnp.zeros_like(above.share)
    if load.force is not None:
        pushed = pushed + (load.force @ d) * above.spheres.height * above.length
    if load.torque is not None:
        pushed = pushed + (load.torque @ cross(n, d)) / 2
    return jnp.sum(above.share * pushed) / (np.pi * scene.viscosity)


def wall_force(t: Time, state: State, scene: Scene) -> Float[Array, " dim"]:
    """Force of the fluid on a no-slip wall, what the beads drive [force]: the sum of all forces on the
    fluid.

    The flow of a force near the wall decays as 1/r^2 or faster, its stress as 1/r^3, so that nothing is
    left for what is far away: the wall takes up the whole force, along it and across, at any height,
    and of torques and stresslets none. What beads that touch the wall or are held by it put on it
    themselves, and the stress of an ambient flow, do not count.

    **Raises** `ValueError` if the domain is no `NoSlipWall`.

    >>> import jaxbeads as jb
    >>> push, wall = jb.force.Weight([2.0, -1.0]), jb.NoSlipWall([0.0, 0.0], [0.0, 1.0])
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=1), 1.0, forces=[push], domain=wall)
    >>> print(jb.observables.wall_force(0.0, jb.State([[0.0, 3.0]]), scene).round(12))
    [ 2. -1.]
    """
    if not isinstance(scene.domain, NoSlipWall):
        fail("scene.domain", "be a NoSlipWall", f"it is {type(scene.domain).__name__}")
    force = load_on_fluid(t, state, scene).force
    if force is None:
        return jnp.zeros_like(state.position[0])
    share = wall(scene.configuration(state, scene.rotational)).share
    return jnp.sum(share[:, None] * force, axis=0)


def swimming_efficiency(speed: Any, mean_power: Any, scene: Scene) -> Float[Array, ""]:
    """Lighthill's efficiency: power to tow the straight, rigid fibre at the swimming speed along its
    axis, over the mean power of the stroke, gamma_par V^2 / P.

    **Raises** `ValueError` for several fibres, which have no common axis.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), viscosity=1.0)
    >>> flat = jb.straight(scene.chain, [1.0, 0.0]).position
    >>> along = jb.observables.rigid_resistance(flat, scene.chain)[0, 0]
    >>> print(f"{jb.observables.swimming_efficiency(0.1, 0.5, scene) / along:.4f}")  # V^2 / P
    0.0200
    """
    if (several := len(scene.chain.fibres)) > 1:
        fail("scene.chain", "be one fibre", f"it has {several}")
    dim = 2
    flat = straight(scene.chain, np.eye(dim)[0]).position
    drag = rigid_resistance(flat, scene.chain, scene.viscosity, scene.mobility)[0, 0]
    return drag * jnp.asarray(speed) ** 2 / mean_power


def _spin(motion: Motion) -> Array:
    return jnp.zeros_like(motion.velocity[..., :0]) if motion.spin is None else motion.spin


def rigid_resistance(
    position: Any, chain: Chain, viscosity: Any = 1.0, mobility: AbstractMobility = _RPY
) -> Float[Array, "motions motions"]:
    """Resistance of the beads moved as one rigid body about their mean position.

    The 6 x 6 matrix (3 x 3 in the plane) that maps (velocity, spin) to (force, torque): K^T M^-1 K,
    where K gives each bead the body's velocity and spin; in units of [force time/length], with a length
    more for each spin. **Arguments**: positions, `(beads, dim)` [length]; chain; mu; mobility.

    >>> import jaxbeads as jb
    >>> bead = jb.Chain(radius=1.0, fibres=1)
    >>> print(jb.observables.rigid_resistance([[0.0, 0.0]], bead).round(4))  # 6 pi, 6 pi, 8 pi
    [[18.8496  0.      0.    ]
     [ 0.     18.8496  0.    ]
     [ 0.      0.     25.1327]]
    """
    return _resistance(jnp.asarray(position), chain, jnp.asarray(viscosity, float), mobility)


@eqx.filter_jit
def _resistance(
    position: Array, chain: Chain, viscosity: Array, mobility: AbstractMobility
) -> Array:
    beads, dim = position.shape
    turns = spins(dim)
    operator = mobility.operator(Configuration(position, chain.radius, viscosity)).kept()
    # Spins times a length and torques over it: pivots must not depend on the unit of length.
    length = jnp.max(chain.radius)

    def column(unit: Array) -> Array:
        moved = operator.motion(Load(unit[:, :dim], length * unit[:, dim:]))
        return jnp.concatenate([moved.velocity, length * _spin(moved)], axis=1).ravel()

    size = beads * (dim + turns)
    matrix = jax.vmap(column)(jnp.eye(size).reshape(size, beads, dim + turns))
    arm = position - jnp.mean(position, axis=0, keepdims=True)
    rows = []
    for unit in np.eye(turns):
        if dim == 2:
            velocity = jnp.stack([-arm[:, 1], arm[:, 0]], axis=1)
        else:
            velocity = jnp.cross(jnp.broadcast_to(unit, arm.shape), arm)
        spin = jnp.broadcast_to(length * unit, (beads, turns))
        rows.append(jnp.concatenate([velocity, spin], axis=1))
    moves = [jnp.tile(np.eye(dim + turns)[i], (beads, 1)) for i in range(dim)]
    body = jnp.stack([row.ravel() for row in (*moves, *rows)], axis=1)
    return body.T @ jnp.linalg.solve(matrix, body)
