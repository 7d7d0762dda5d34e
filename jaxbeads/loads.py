"""Loads on the beads at one instant: who exerts which, and what a fibre carries along itself.

Inertia is negligible: on each bead the loads of forces, of constraints and of the fluid add up to none.
Each load here is what its name exerts on the beads. They are those of the equations, so a bead's torque
is about its centre, and its force acts there.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import described, fail, index
from ._typing import float_array
from .chain import Chain
from .constraint import AbstractConstraint, Joint
from .dynamics import evaluate, multipliers, named
from .force import AbstractPotential, Bending
from .geometry import bonds, cross, tangents
from .instant import Time, applied_load
from .saddle import Evaluation, constraint_map
from .scene import Scene
from .state import Load, Motion, State, add_loads, check_single, spins, zero_motion


def load_on_fluid(t: Time, state: State, scene: Scene) -> Load:
    """Forces [force] and torques [force length] that each bead exerts on the fluid: all those of the
    scene's forces and constraints, which it hands on. M of it, V_inf and C:E are the motion.

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=3), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> down = jb.straight(scene.chain, [0.0, -1.0])
    >>> print(abs(jb.observables.load_on_fluid(0.0, down, scene).force).max() < 1e-12)  # it is at rest
    True
    """
    return handed_on(t, state, scene, evaluate(t, state, scene) if scene.constraints else None)


def handed_on(t: Time, state: State, scene: Scene, found: Evaluation | None) -> Load:
    """As `load_on_fluid`, of an instant that is found."""
    load = applied_load(t, state, scene)
    if found is None or not scene.constraints:
        return load
    return add_loads(load, constraint_map(t, state, scene).pull(found.multipliers))


def drag(t: Time, state: State, scene: Scene) -> Load:
    """Hydrodynamic force [force] and torque [force length] of the fluid on each bead, minus that of the
    bead on the fluid.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=2), 1.0, forces=[jb.force.Weight([0.0, -1.0])])
    >>> print(jb.observables.drag(0.0, jb.straight(scene.chain, [1.0, 0.0]), scene).force + 0.0)
    [[0. 1.]
     [0. 1.]]
    """
    return jax.tree.map(jnp.negative, load_on_fluid(t, state, scene))


def constraint_loads(t: Time, state: State, scene: Scene) -> dict[str, Load]:
    """Forces [force] and torques [force length] that each constraint exerts on the beads, by its name,
    as "Gears" or "PrescribedPosition(bead=0)" (a second one of that name has " 2" after it).

    Those of a chain constraint add up to no force and no torque; those of one that holds or drives a
    bead are the load that the holder exerts.

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=3), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> loads = jb.observables.constraint_loads(0.0, jb.straight(scene.chain, [0.0, -1.0]), scene)
    >>> for name, load in loads.items():
    ...     print(name, load.force[:, 1].round(6))
    Inextensible [-2.  1.  1.]
    PrescribedPosition(bead=0) [3. 0. 0.]
    """
    every, still = multipliers(t, state, scene), zero_motion(state, scene.rotational)
    loads: dict[str, Load] = {}
    first = 0
    for constraint in scene.constraints:

        def slip(motion: Motion, constraint=constraint) -> Array:
            return jnp.ravel(constraint.slip(jnp.asarray(t), state, motion, scene.chain))

        rows, pull = jax.vjp(slip, still)
        (pulled,) = pull(every[first : first + len(rows)])
        first += len(rows)
        name = named(constraint)
        same = sum(key == name or key.startswith(f"{name} ") for key in loads)
        loads[f"{name} {same + 1}" if same else name] = Load(pulled.velocity, pulled.spin)
    return loads


def net_load(
    load: Load, state: State, about: Any
) -> tuple[Float[Array, " dim"], Float[Array, " spins"]]:
    """Sum of the forces [force], `(dim,)`, and of all torques about a point [force length], `(1,)` in
    the plane and `(3,)` in space.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> load = jb.Load(force=jnp.array([[0.0, 0.0], [0.0, -1.0]]))
    >>> force, torque = jb.observables.net_load(load, jb.State([[0.0, 0.0], [2.0, 0.0]]), [0.0, 0.0])
    >>> print(force, torque)
    [ 0. -1.] [-2.]
    """
    dim, dtype = state.position.shape[1], state.position.dtype
    force, torque = jnp.zeros(dim, dtype), jnp.zeros(spins(dim), dtype)
    if load.force is not None:
        force = jnp.sum(load.force, axis=0)
        arm = state.position - float_array(about)[None]
        torque = torque + jnp.sum(cross(arm, load.force), axis=0)
    if load.torque is not None:
        torque = torque + jnp.sum(load.torque, axis=0)
    return force, torque


def holding_load(
    t: Time, state: State, scene: Scene, bead: int = 0
) -> tuple[Float[Array, " dim"], Float[Array, " spins"]]:
    """Force [force] and torque about the bead's centre [force length] that what holds or drives a bead
    exerts on the fibre: of the constraints that name it or a bond that it has, as `clamped` and
    `hinged` do. The thrust of a beating filament on its holder is minus that force.

    **Argument** `bead`: its index, -1 for the last. **Returns** `(dim,)`, and `(1,)` in the plane or
    `(3,)` in space. **Raises** `ValueError` for several beads and if nothing holds it.

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=3), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> force, _ = jb.observables.holding_load(0.0, jb.straight(scene.chain, [0.0, -1.0]), scene)
    >>> print(f"{force[1]:.6f}")  # the weight of three beads
    3.000000
    """
    beads, held = scene.chain.beads, []
    if np.ndim(bead) != 0:
        fail("bead", "be one index (of several, call it for each)", f"it is {described(bead)}")
    index("bead", bead, beads)
    bead = bead % beads
    every = constraint_loads(t, state, scene).values()
    for constraint, load in zip(scene.constraints, every, strict=True):
        at = _named(constraint, "bead", beads) == bead
        bond = _named(constraint, "bond", beads - 1)
        bond = bond[(bond == bead) | (bond == bead - 1)]
        if at.any() or len(bond):  # of all that it names, the rows of this one
            rows = np.isin(np.arange(beads), [bead] if at.any() else [*bond, *(bond + 1)])
            held.append(jax.tree.map(lambda x, rows=rows: jnp.where(rows[:, None], x, 0.0), load))
    if not held:
        fail("bead", "be one that a constraint of the scene holds", f"nothing names bead {bead}")
    return net_load(add_loads(*held), state, state.position[bead])


def _named(constraint: AbstractConstraint, what: str, number: int) -> np.ndarray:
    """The beads or bonds that a constraint names, counted from the first."""
    named = getattr(constraint, what, ())
    return np.atleast_1d(np.asarray(named, int)) % max(number, 1)


def stress_resultants(
    t: Time, state: State, scene: Scene
) -> tuple[Float[Array, "bonds dim"], Float[Array, "bonds spins"]]:
    """Force n [force] and moment m [force length] that the part of a fibre beyond each bond exerts on
    the part before it, m about the contact (or joint) of the bond's beads:

        n_k = sum over j <= k of F_j,   m_k = sum over j <= k of T_j + (r_j - c_k) x F_j,

    with the loads of all that acts between neighbours (terms that say `internal` or `links`). They
    balance what acts on the part before from elsewhere: weight, drag, contact, holders (a clamp holds
    its first bond by its two beads, so what it exerts is within that bond). Elastic moments live at
    beads: under `Gears` m_k is the mean of those of the bond's two beads, under `Joint` that of the
    joint.

    **Returns** `(beads - 1, dim)` and `(beads - 1, 1 or 3)`; 0 from a fibre to the next.

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=3), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> down = jb.straight(scene.chain, [0.0, -1.0])
    >>> force, moment = jb.observables.stress_resultants(0.0, down, scene)
    >>> print(force[:, 1].round(6), moment.shape)  # what hangs on each bond
    [-2. -1.] (2, 1)
    """
    chain, position = scene.chain, state.position
    load = _internal_load(t, state, scene)
    force = jnp.zeros_like(position) if load.force is None else load.force
    none = jnp.zeros((chain.beads, spins(position.shape[1])), position.dtype)
    torque = none if load.torque is None else load.torque
    # From the centre of each fibre: sums of large moments lose digits.
    r = position - chain.centres(position)[chain.fibre_of_bead]
    sums, turns = (_up_to_bond(x, chain) for x in (force, torque + cross(r, force)))
    if any(isinstance(c, Joint) for c in scene.constraints) and state.director is not None:
        arm = (state.director * chain.reach[:, None])[:-1]
    else:
        arm = bonds(position) * (chain.reach[:-1] / chain.bond_length)[:, None]
    moment = turns - cross(r[:-1] + arm, sums)
    mask = jnp.asarray(chain.bond_mask)[:, None]
    return jnp.where(mask, sums, 0.0), jnp.where(mask, moment, 0.0)


def _internal_load(t: Time, state: State, scene: Scene) -> Load:
    """What acts between neighbours of a fibre."""
    inner = [k for k, f in enumerate(scene.forces) if f.internal or f.links]
    loads = [scene.load_of(k, t, state) for k in inner]
    if any(c.internal or c.links for c in scene.constraints):
        every = constraint_loads(t, state, scene).values()
        pairs = zip(scene.constraints, every, strict=True)
        loads += [load for c, load in pairs if c.internal or c.links]
    return add_loads(*loads)


def _up_to_bond(x: Float[Array, "beads n"], chain: Chain) -> Float[Array, "bonds n"]:
    """Sum over the beads of a fibre up to the first one of each bond."""
    first = np.cumsum((0, *chain.fibres))[chain.fibre_of_bead[:-1]]
    before = jnp.pad(jnp.cumsum(x, axis=0), ((1, 0), (0, 0)))
    return before[1:-1] - before[first]


def tension(t: Time, state: State, scene: Scene) -> Float[Array, " bonds"]:
    """Tension in each bond, n . e [force], positive where it pulls its beads together; 0 from a fibre
    to the next. See `stress_resultants`.

    >>> import jaxbeads as jb
    >>> hung = [jb.constraint.Inextensible(), *jb.constraint.hinged()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=3), 1.0, constraints=hung, forces=[jb.force.Weight([0.0, -1.0])]
    ... )
    >>> print(jb.observables.tension(0.0, jb.straight(scene.chain, [0.0, -1.0]), scene).round(6))
    [2. 1.]
    """
    return jnp.sum(stress_resultants(t, state, scene)[0] * tangents(state.position), axis=1)


def shear_force(t: Time, state: State, scene: Scene) -> Float[Array, "bonds dim"]:
    """Shear force in each bond, n - (n . e) e [force], `(beads - 1, dim)`: what the part of the fibre
    beyond it exerts on that before it across the fibre. See `stress_resultants`.

    >>> import jaxbeads as jb
    >>> beam = [jb.constraint.Gears(), *jb.constraint.clamped()]
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=3),
    ...     viscosity=1.0,
    ...     constraints=[*beam, jb.constraint.FrozenJoints()],
    ...     forces=[jb.force.Weight([0.0, -1.0])],
    ... )
    >>> across = jb.observables.shear_force(0.0, jb.straight(scene.chain, [1.0, 0.0]), scene)
    >>> print(across[1].round(6) + 0.0)  # the weight of the last bead
    [ 0. -1.]
    """
    n, e = stress_resultants(t, state, scene)[0], tangents(state.position)
    return n - jnp.sum(n * e, axis=1, keepdims=True) * e


def bending_moment(t: Time, state: State, scene: Scene) -> Float[Array, "bonds spins"]:
    """Moment in each bond [force length], `(beads - 1, 1)` in the plane, where that of a fibre bent
    anticlockwise is positive (K_b kappa), and `(beads - 1, 3)` in space. See `stress_resultants`.

    >>> import jaxbeads as jb
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> gears, bending = jb.constraint.Gears(), jb.force.Bending(10.0)
    >>> scene = jb.Scene(chain, viscosity=1.0, constraints=[gears], forces=[bending])
    >>> bent = jb.State(jb.from_tangents(chain, [[1.0, 0.0], [0.8, 0.6]]))
    >>> print(jb.observables.bending_moment(0.0, bent, scene).ravel().round(6))  # half of K_b kappa
    [1.5 1.5]
    """
    return stress_resultants(t, state, scene)[1]


def elastic_energy(t: Time, state: State, scene: Scene) -> Float[Array, ""]:
    """Energy of all elastic forces [force length]: bending, springs, potentials of your own that say
    `links`.

    Bending counts from the straight fibre, sum of K_b l (kappa^2/2 - kappa_0 kappa) for small turns:
    what is preferred has the least energy, a negative one. **Raises** `ValueError` for an elastic force
    without an energy (`JointBending`, a curvature at rest given as vectors).

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=2), viscosity=1.0, forces=[jb.force.Spring(4.0)])
    >>> print(jb.observables.elastic_energy(0.0, jb.State([[0.0, 0.0], [2.5, 0.0]]), scene))
    0.5
    """
    check_single(state)
    energy = jnp.zeros((), state.position.dtype)
    for force in scene.forces:
        if not (force.internal or force.links):
            continue
        if isinstance(force, (AbstractPotential, Bending)):
            energy = energy + force.energy(jnp.asarray(t), state, scene)
        elif force.stiff:
            fail("scene.forces", "have energies", f"{type(force).__name__} has none")
    return energy
