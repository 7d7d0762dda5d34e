"""Pair tensors of spheres in Stokes flow: Rotne-Prager-Yamakawa with rotation, and the response to
strain. Pure functions of positions.

Lengths are divided by a radius before they are raised to powers, and powers of that radius multiply the
results: in single precision the sixth power of a micrometre is not there.
"""

from collections.abc import Callable
from functools import reduce

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .coefficients import kept_coefficients, separation, strain_coefficients
from .configuration import Configuration
from .pairs import CROSS, Field, PairTensor, Radii, Signed, Table
from .state import Load, Motion, spins

__all__ = ["rpy", "rpy_gradient", "rpy_motion", "shear_disturbance"]


def rpy(configuration: Configuration) -> PairTensor:
    """Rotne-Prager-Yamakawa mobility of spheres, separate or overlapping.

    With d = r_i - r_j: v_i = (tt1 I + tt2 d d) F_j + tr T_j x d and w_i = rt F_j x d +
    (rr1 I + rr2 d d) T_j, positive definite in every configuration.

    **Returns** a `PairTensor`, of translation alone where spins take no part.

    References: Wajnryb, Mizerski, Zuk & Szymczak, J. Fluid Mech. 731 (2013) R3 (equal radii); Zuk,
    Wajnryb, Mizerski & Szymczak, J. Fluid Mech. 741 (2014) R5 (unequal radii).

    >>> import jaxbeads as jb
    >>> beads = jb.Configuration([[0.0, 0.0], [4.0, 0.0]], radius=1.0, viscosity=1.0)
    >>> table = jb.tensors.rpy(beads).tt[0][0]
    >>> print((table / table[0, 0]).round(4))  # 3a/(2R) - (a/R)^3 of one on the other, along their axis
    [[1.     0.3594]
     [0.3594 1.    ]]
    """
    scaled = configuration.scaled
    vector, radii = scaled.pairs()
    k = kept_coefficients(vector, radii, scaled.length, configuration.viscosity)
    dim, turns = len(vector), spins(len(vector))
    tt = _dyads(k.tt1, k.tt2, vector)
    if not configuration.rotational:
        return PairTensor(tt)
    push = [k.tr * d for d in vector]
    twist = push if k.rt is k.tr else [k.rt * d for d in vector]
    tr: list[list[Signed | None]] = [[None] * turns for _ in range(dim)]
    rt: list[list[Signed | None]] = [[None] * dim for _ in range(turns)]
    for i, j, m, sign in CROSS[dim]:  # (d x T)_i holds sign d_j T_m, and (d x F)_m the opposite
        tr[i][m], rt[m][i] = Signed(push[j], -sign), Signed(twist[j], sign)
    rr: Table = ((k.rr1,),) if dim == 2 else _dyads(k.rr1, k.rr2, vector)
    return PairTensor(tt, tuple(map(tuple, tr)), tuple(map(tuple, rt)), rr)


def rpy_motion(configuration: Configuration, load: Load) -> Motion:
    """M F as `rpy(...).motion(load)`, but pair by pair: no field outlives the sum that it goes into, and
    derivatives need no outer products. Memory grows like the number of beads (see `pair_sums`).

    >>> import jax.numpy as jnp, jaxbeads as jb
    >>> beads = jb.Configuration([[0.0, 0.0], [4.0, 0.0]], 1.0, 1.0, rotational=False)
    >>> print(jb.tensors.rpy_motion(beads, jb.Load(force=6.0 * jnp.eye(2))).velocity.round(4))
    [[0.3183 0.0622]
     [0.1144 0.3183]]
    """
    scaled, rotational = configuration.scaled, configuration.rotational

    def fields(vector: list[Field], radii: Radii | None) -> tuple[Field, ...]:
        return pushed(vector, radii, scaled.length, configuration.viscosity, rotational, load)

    return as_motion(scaled.sums(fields), configuration)


def as_motion(sums: list[Array], configuration: Configuration) -> Motion:
    """Components of velocities, and of spins where they take part, on the last axis."""
    dim = configuration.dim
    velocity = jnp.stack(sums[:dim], axis=-1)
    return Motion(velocity, jnp.stack(sums[dim:], axis=-1) if configuration.rotational else None)


def pushed(
    vector: list[Field],
    radii: Radii | None,
    length: Array,
    viscosity: Array,
    rotational: bool,
    load: Load,
) -> tuple[Field, ...]:
    """What the load on bead j adds to each component of velocity and spin of bead i: fields."""
    k = kept_coefficients(vector, radii, length, viscosity)
    dim, turns = len(vector), spins(len(vector))
    force = None if load.force is None else list(load.force.T[:, None, :])
    torque = None if load.torque is None else list(load.torque.T[:, None, :])

    def dyadic(one: Array, two: Array, x: list[Array]) -> list[Array]:
        along = two * sum(d * c for d, c in zip(vector, x, strict=True))
        return [one * c + along * d for d, c in zip(vector, x, strict=True)]

    velocity, spin = [[] for _ in range(dim)], [[] for _ in range(turns)]
    if force is not None:
        for i, field in enumerate(dyadic(k.tt1, k.tt2, force)):
            velocity[i].append(field)
    if not rotational:
        return tuple(reduce(jnp.add, terms) for terms in velocity)
    if torque is not None:
        angular = [k.rr1 * torque[0]] if dim == 2 else dyadic(k.rr1, k.rr2, torque)
        for i, field in enumerate(angular):
            spin[i].append(field)
    for i, j, m, sign in CROSS[dim]:  # T x d and F x d
        if torque is not None:
            velocity[i].append(-sign * (k.tr * (vector[j] * torque[m])))
        if force is not None:
            spin[m].append(sign * (k.rt * (vector[j] * force[i])))
    return tuple(reduce(jnp.add, terms) for terms in velocity + spin)


def _dyads(one: Array, two: Array, vector: list[Field]) -> Table:
    dim = len(vector)
    fields: dict[tuple[int, int], Array] = {}
    for i in range(dim):
        for j in range(i, dim):
            field = two * (vector[i] * vector[j])
            fields[i, j] = fields[j, i] = field + one if i == j else field
    return tuple(tuple(fields[i, j] for j in range(dim)) for i in range(dim))


def shear_disturbance(
    configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
) -> Motion:
    """C : E, the motion that freely suspended spheres induce on one another in a straining flow.

    With d = r_i - r_j and the strain rate E_j at sphere j: v_i = c1 E_j.d + c2 (d.E_j.d) d and
    w_i = cr (E_j.d) x d, summed over j.

    **Arguments**: configuration; rate of strain [1/time], one tensor `(dim, dim)` for all beads or one
    for each, `(beads, dim, dim)`.

    Reference: Wajnryb et al., J. Fluid Mech. 731 (2013) R3; Zuk et al., ibid. 741 (2014) R5.

    >>> import jax.numpy as jnp, jaxbeads as jb
    >>> beads = jb.Configuration([[0.0, 0.0], [4.0, 0.0]], 1.0, 1.0, rotational=False)
    >>> extension = jnp.array([[1.0, 0.0], [0.0, -1.0]])
    >>> print(jb.tensors.shear_disturbance(beads, extension).velocity.round(4))  # it holds them back
    [[ 0.1406  0.    ]
     [-0.1406  0.    ]]
    """
    scaled = configuration.scaled

    def fields(vector: list[Field], radii: Radii | None) -> tuple[Field, ...]:
        return strained(vector, radii, scaled.length, strain_rate, configuration.rotational)

    return as_motion(scaled.sums(fields), configuration)


def strained(
    vector: list[Field],
    radii: Radii | None,
    length: Array,
    strain_rate: Array,
    rotational: bool,
) -> tuple[Field, ...]:
    """What the strain at bead j adds to each component of velocity and spin of bead i: fields."""
    s, dim, d = separation(vector), len(vector), vector
    c1, c2, cr = strain_coefficients(s, radii)
    strain_rate, cr = strain_rate * length, cr / length  # the tensor is small, a field is not
    # One tensor: numbers; one for each bead: rows along j.
    rows = strain_rate if strain_rate.ndim == 2 else strain_rate[None]
    e = [[rows[..., i, j] for j in range(dim)] for i in range(dim)]
    ed = [sum(e[i][j] * d[j] for j in range(dim)) for i in range(dim)]
    ded = c2 * sum(d[i] * ed[i] for i in range(dim))
    velocity = tuple(c1 * ed[i] + ded * d[i] for i in range(dim))
    if not rotational:
        return velocity
    if dim == 2:
        return (*velocity, cr * (ed[0] * d[1] - ed[1] * d[0]))
    turn: list[list[Field]] = [[], [], []]
    for i, j, k, sign in CROSS[3]:
        turn[i].append(sign * ed[j] * d[k])
    return (*velocity, *(cr * reduce(jnp.add, terms) for terms in turn))


def rpy_gradient(
    configuration: Configuration,
    load: Load,
    strain: Callable[[Array], Array] | None,
    shifts: Float[Array, "shifts beads dim"],
) -> Motion:
    """Derivatives of M F + C:E along shifts of the positions, with F held.

    What bead j does to bead i depends on their separation d; its derivative by d, found for each pair
    once, is taken times s_i - s_j for a shift s and summed over j.

    **Arguments**: configuration; loads; rate of strain as a function of positions (see
    `shear_disturbance`) or `None`; shifts [length]. **Returns** motions, a leading axis of shifts.

    >>> import jax.numpy as jnp, jaxbeads as jb
    >>> beads = jb.Configuration([[0.0, 0.0], [4.0, 0.0]], 1.0, 1.0, rotational=False)
    >>> load, apart = jb.Load(force=jnp.ones((2, 2))), jnp.array([[[0.0, 0.0], [1.0, 0.0]]])
    >>> print(jb.tensors.rpy_gradient(beads, load, None, apart).velocity[0, :, 0].round(4))
    [-0.0044 -0.0044]
    """
    position, dim, scaled = configuration.position, configuration.dim, configuration.scaled
    vectors, radii = scaled.pairs()
    length, shifts = scaled.length, shifts / scaled.length
    viscosity, rotational = configuration.viscosity, configuration.rotational
    loaded = load.force is not None or load.torque is not None

    def pairs(vector: list[Field], rate: Array | None) -> tuple[Field, ...]:
        moved: list[tuple[Field, ...]] = []
        if loaded:
            moved.append(pushed(vector, radii, length, viscosity, rotational, load))
        if rate is not None:
            moved.append(strained(vector, radii, length, rate, rotational))
        return tuple(reduce(jnp.add, parts) for parts in zip(*moved, strict=True))

    rate = None if strain is None else strain(position)
    units = jnp.eye(dim, dtype=position.dtype)[:, :, None, None]
    along = [jnp.broadcast_to(units[:, c], (dim, *d.shape)) for c, d in enumerate(vectors)]
    slopes = jax.vmap(jax.linearize(lambda v: pairs(v, rate), vectors)[1])(along)
    own = [f.sum(axis=2) for f in slopes]
    if strain is not None and rate is not None and rate.ndim == 3:
        # The strain at bead j changes with its place.
        shift = jnp.broadcast_to(length * units[:, None, :, 0, 0], (dim, *position.shape))
        slope = jax.vmap(jax.linearize(strain, position)[1])(shift)
        others = jax.vmap(lambda e: strained(vectors, radii, length, e, rotational))(slope)
        slopes = [f - g for f, g in zip(slopes, others, strict=True)]
    total = [
        jnp.einsum("sic,ci->si", shifts, o) - jnp.einsum("sjc,cij->si", shifts, f)
        for o, f in zip(own, slopes, strict=True)
    ]
    return as_motion(total, configuration)
