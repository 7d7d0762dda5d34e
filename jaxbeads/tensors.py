"""Pair tensors of spheres in Stokes flow: Rotne-Prager-Yamakawa with rotation, and the response to
strain. Pure functions of positions; viscosity 1 unless said.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .pairs import CROSS, Field, PairTensor, Radii, Signed, Table, pair_sums, radii_of, separations
from .state import Load, Motion, spins


class _Separation(NamedTuple):
    vector: list[Field]  # r_i - r_j
    distance: Field  # 0 on the diagonal
    inverse: Field  # 1 / distance, 0 where the distance is 0


@jax.custom_jvp
def _root(square: Field) -> Field:
    """A square root without a slope at 0, where two beads are in the same place."""
    return jnp.sqrt(square)


@_root.defjvp
def _root_jvp(primals: tuple[Field], tangents: tuple[Field]) -> tuple[Field, Field]:
    root = _root(*primals)
    zero = root == 0
    # XLA: a division, as in `_coefficients`: in reverse, all that depends on r is summed once.
    return root, jnp.where(zero, 0.0, tangents[0]) / jnp.where(zero, 1.0, 2 * root)


def _inverse(distance: Field) -> Field:
    zero = distance == 0
    return jnp.where(zero, 0.0, 1.0) / jnp.where(zero, 1.0, distance)


def _separation(vector: list[Field]) -> _Separation:
    distance = _root(sum(d * d for d in vector))
    return _Separation(vector, distance, _inverse(distance))


class _Scalars(NamedTuple):
    """Coefficients of I, dd, d x, with d = r_i - r_j (not normalised)."""

    tt1: Array
    tt2: Array
    tr: Array  # v_i = tr T_j x d
    rt: Array  # w_i = rt F_j x d
    rr1: Array
    rr2: Array


def _equal(s: _Separation, a: Array) -> _Scalars:
    # On the diagonal the overlap branch at distance 0 is the mobility of a single sphere.
    x, ix = s.distance * (1 / a), s.inverse * a
    y = jnp.minimum(ix, 0.5)  # 1/x of separate spheres; bounded where the other branch holds
    y2, y3 = y * y, y * y * y
    near = x <= 2
    six, eight = 1 / (6 * np.pi * a), 1 / (8 * np.pi * a**3)
    tr = eight * jnp.where(near, 0.5 - 3 * x / 16, y3)
    return _Scalars(
        tt1=six * jnp.where(near, 1 - 9 * x / 32, 0.75 * y + 0.5 * y3),
        tt2=(six / a**2) * jnp.where(near, 3 * ix / 32, (0.75 - 1.5 * y2) * y3),
        tr=tr,
        rt=tr,
        rr1=eight * jnp.where(near, 1 - 27 * x / 32 + 5 * x * x * x / 64, -0.5 * y3),
        rr2=(eight / a**2) * jnp.where(near, 9 * ix / 32 - 3 * x / 64, 1.5 * y2 * y3),
    )


def _overlap_rr(r: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """rr of overlapping spheres times 8 pi (a b)^3: coefficients of I and of the unit dyad."""
    d2, r2, r3 = (a - b) ** 2, r**2, r**3
    s = a**2 + 4 * a * b + b**2
    one = 5 * r**6 - 27 * r**4 * (a**2 + b**2) + 32 * r3 * (a**3 + b**3)
    one = one - 9 * r2 * (a**2 - b**2) ** 2 - d2**2 * s
    return one / (64 * r3), 3 * (d2 - r2) ** 2 * (s - r2) / (64 * r3)


def _overlap_rt(r: Array, a: Array, b: Array) -> Array:
    """rt of overlapping spheres: spin of the sphere of radius a, force on that of radius b."""
    return (
        (a - b + r) ** 2
        * (b**2 + 2 * b * (a + r) - 3 * (a - r) ** 2)
        / (128 * np.pi * r**2 * a**3 * b)
    )


def _unequal(s: _Separation, a: Array, b: Array) -> _Scalars:
    inside = s.distance <= jnp.abs(a - b)  # one sphere within the other; also the diagonal
    near = s.distance <= a + b
    r = jnp.where(inside, a + b, s.distance)  # a regular value where the branch is not taken
    ir, big = 1 / r, jnp.maximum(a, b)
    m, q, sq = 1 / (6 * np.pi * a * b), 1 / (8 * np.pi * (a * b) ** 3), a**2 + b**2
    k, d2, r2 = 1 / (8 * np.pi * r), (a - b) ** 2, r**2
    rr1, rr2 = _overlap_rr(r, a, b)

    def choose(within: Array | float, overlap: Array, apart: Array) -> Array:
        return jnp.where(inside, within, jnp.where(near, overlap, apart))

    cross_apart = 1 / (8 * np.pi * r**3)
    return _Scalars(
        tt1=choose(
            1 / (6 * np.pi * big),
            m * (16 * r**3 * (a + b) - (d2 + 3 * r2) ** 2) / (32 * r**3),
            k * (1 + sq / (3 * r2)),
        ),
        tt2=choose(0.0, m * 3 * (d2 - r2) ** 2 / (32 * r**5), k * (1 - sq / r2) * ir**2),
        tr=choose(
            jnp.where(b > a, 1 / (8 * np.pi * b**3), 0.0), _overlap_rt(r, b, a) * ir, cross_apart
        ),
        rt=choose(
            jnp.where(a > b, 1 / (8 * np.pi * a**3), 0.0), _overlap_rt(r, a, b) * ir, cross_apart
        ),
        rr1=choose(1 / (8 * np.pi * big**3), q * rr1, -1 / (16 * np.pi * r**3)),
        rr2=choose(0.0, q * rr2 * ir**2, 3 / (16 * np.pi * r**5)),
    )


def _coefficients(vector: list[Field], radii: Radii, viscosity: Array) -> _Scalars:
    """The coefficients of each pair."""
    s = _separation(vector)
    k = _unequal(s, *radii) if isinstance(radii, tuple) else _equal(s, radii)
    # XLA: each ends in a division; on the CPU it computes what looks cheap anew wherever it is read, but
    # never a division.
    tt1, tt2, tr, rt, rr1, rr2 = (x / viscosity for x in k)
    return _Scalars(tt1, tt2, tr, tr if k.rt is k.tr else rt, rr1, rr2)


def rpy(
    position: Float[Array, "beads dim"],
    radius: Float[Array, ""] | Float[Array, " beads"],
    viscosity: Float[Array, ""],
    rotational: bool,
) -> PairTensor:
    """Rotne-Prager-Yamakawa mobility of spheres, separate or overlapping.

    With d = r_i - r_j: v_i = (tt1 I + tt2 d d) F_j + tr T_j x d and w_i = rt F_j x d +
    (rr1 I + rr2 d d) T_j, positive definite in every configuration.

    **Arguments**: positions [length]; radius, one or one per bead; viscosity [force time/length^2];
    whether spins and torques take part. **Returns** a `PairTensor`.

    References: Wajnryb, Mizerski, Zuk & Szymczak, J. Fluid Mech. 731 (2013) R3 (equal radii); Zuk,
    Wajnryb, Mizerski & Szymczak, J. Fluid Mech. 741 (2014) R5 (unequal radii).
    """
    vector, radii = separations(position, position), radii_of(radius, radius)
    k, dim, turns = _coefficients(vector, radii, viscosity), len(vector), spins(len(vector))
    tt = _dyads(k.tt1, k.tt2, vector)
    if not rotational:
        return PairTensor(tt)
    push = [k.tr * d for d in vector]
    twist = push if k.rt is k.tr else [k.rt * d for d in vector]
    tr: list[list[Signed | None]] = [[None] * turns for _ in range(dim)]
    rt: list[list[Signed | None]] = [[None] * dim for _ in range(turns)]
    for i, j, m, sign in CROSS[dim]:  # (d x T)_i holds sign d_j T_m, and (d x F)_m the opposite
        tr[i][m], rt[m][i] = Signed(push[j], -sign), Signed(twist[j], sign)
    rr: Table = ((k.rr1,),) if dim == 2 else _dyads(k.rr1, k.rr2, vector)
    return PairTensor(tt, tuple(map(tuple, tr)), tuple(map(tuple, rt)), rr)


def rpy_motion(
    position: Float[Array, "beads dim"],
    radius: Float[Array, ""] | Float[Array, " beads"],
    viscosity: Float[Array, ""],
    rotational: bool,
    load: Load,
) -> Motion:
    """M F as `rpy(...).motion(load)`, but pair by pair: no field outlives the sum that it goes into, and
    derivatives need no outer products. Memory grows like the number of beads (see `pair_sums`).

    **Arguments**: as for `rpy`; loads. **Returns** a `Motion`.
    """

    def fields(vector: list[Field], radii: Radii) -> tuple[Field, ...]:
        return _pushed(vector, radii, viscosity, rotational, load)

    sums, dim = _sums(fields, position, radius), position.shape[1]
    velocity = jnp.stack(sums[:dim], axis=1)
    return Motion(velocity, jnp.stack(sums[dim:], axis=1) if rotational else None)


def _sums(
    fields: Callable[[list[Field], Radii], Sequence[Field]], position: Array, radius: Array
) -> list[Array]:
    """Sums over j of functions of r_i - r_j and the radii."""
    if radius.ndim == 0:
        return pair_sums(lambda to, of: fields(separations(to, of), radius), position)

    def unequal(to: tuple[Array, Array], of: tuple[Array, Array]) -> Sequence[Field]:
        return fields(separations(to[0], of[0]), radii_of(to[1], of[1]))

    return pair_sums(unequal, (position, radius))


def _pushed(
    vector: list[Field], radii: Radii, viscosity: Array, rotational: bool, load: Load
) -> tuple[Field, ...]:
    """What the load on bead j adds to each component of velocity and spin of bead i."""
    k, dim, turns = _coefficients(vector, radii, viscosity), len(vector), spins(len(vector))
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


def _strain_equal(s: _Separation, a: Array) -> tuple[Array, Array, Array]:
    x, ix = s.distance / a, s.inverse * a
    y = jnp.minimum(ix, 0.5)
    y2, y3 = y * y, y * y * y
    near = x <= 2
    c1 = jnp.where(near, -0.5 + 5 * x / 24, -8 / 3 * y2 * y3)
    c2 = jnp.where(near, -5 * ix / 96, (20 / 3 * y2 - 2.5) * y2 * y3) / a**2
    cr = jnp.where(near, (5 * x * x - 30) * ix / 64, -2.5 * y2 * y3) / a**2
    return c1, c2, cr


def _strain_unequal(s: _Separation, a: Array, b: Array) -> tuple[Array, Array, Array]:
    inside, near = s.distance <= jnp.abs(a - b), s.distance <= a + b
    r = jnp.where(inside, a + b, s.distance)
    d, r2, sq = a - b, r**2, 5 * a**2 + 3 * b**2
    c1_near = 10 * r**6 - 24 * a * r**5 - 15 * r**4 * (b**2 - a**2) - d**5 * (a + 5 * b)
    c2_near = 5 * (d**2 - r2) ** 2 * (d * (a + 5 * b) - r2)
    cr_near = -5 * _overlap_rr(r, a, b)[1] / (3 * a**3)
    c1 = jnp.where(near, c1_near / (48 * a * r**5), -(b**3) * sq / (3 * r**5))
    c2 = jnp.where(near, c2_near / (96 * a * r**7), b**3 * (5 * sq - 15 * r2) / (6 * r**7))
    cr = jnp.where(near, cr_near / r2, -2.5 * b**3 / r**5)
    within = jnp.where(b > a, -1.0, 0.0)
    return (
        jnp.where(inside, within, c1),
        jnp.where(inside, 0.0, c2),
        jnp.where(inside, 0.0, cr),
    )


def shear_disturbance(
    position: Float[Array, "beads dim"],
    radius: Float[Array, ""] | Float[Array, " beads"],
    strain_rate: Float[Array, "*beads dim dim"],
    rotational: bool,
) -> Motion:
    """C : E, the motion that freely suspended spheres induce on one another in a straining flow.

    With d = r_i - r_j and the strain rate E_j at sphere j: v_i = c1 E_j.d + c2 (d.E_j.d) d and
    w_i = cr (E_j.d) x d, summed over j.

    **Arguments**: positions; radius; rate of strain [1/time], one tensor `(dim, dim)` for all beads
    or one for each, `(beads, dim, dim)`; whether spins take part. **Returns** a `Motion`.

    Reference: Wajnryb et al., J. Fluid Mech. 731 (2013) R3; Zuk et al., ibid. 741 (2014) R5.
    """
    dim = position.shape[1]

    def fields(vector: list[Field], radii: Radii) -> tuple[Field, ...]:
        return _disturbance(vector, radii, strain_rate, rotational)

    sums = _sums(fields, position, radius)
    velocity = jnp.stack(sums[:dim], axis=1)
    return Motion(velocity, jnp.stack(sums[dim:], axis=1) if rotational else None)


def _disturbance(
    vector: list[Field], radii: Radii, strain_rate: Array, rotational: bool
) -> tuple[Field, ...]:
    """What the strain at bead j adds to each component of velocity and spin of bead i."""
    s, dim, d = _separation(vector), len(vector), vector
    unequal = isinstance(radii, tuple)
    c1, c2, cr = _strain_unequal(s, *radii) if unequal else _strain_equal(s, radii)
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
    turn = [jnp.zeros(())] * 3
    for i, j, k, sign in CROSS[3]:
        turn[i] = turn[i] + sign * ed[j] * d[k]
    return (*velocity, *(cr * w for w in turn))


def rpy_gradient(
    position: Float[Array, "beads dim"],
    radius: Float[Array, ""] | Float[Array, " beads"],
    viscosity: Float[Array, ""],
    rotational: bool,
    load: Load,
    strain: Callable[[Array], Array] | None,
    shifts: Float[Array, "shifts beads dim"],
) -> Motion:
    """Derivatives of M F + C:E along shifts of the positions, with F held.

    What bead j does to bead i depends on their separation d; its derivative by d, found for each pair
    once, is taken times s_i - s_j for a shift s and summed over j.

    **Arguments**: as for `rpy`; loads; rate of strain as a function of positions (see
    `shear_disturbance`) or `None`; shifts [length]. **Returns** motions, a leading axis of shifts.
    """
    dim, vectors = position.shape[1], separations(position, position)
    radii = radii_of(radius, radius)
    loaded = load.force is not None or load.torque is not None

    def pairs(vector: list[Field], rate: Array | None) -> tuple[Field, ...]:
        moved: list[tuple[Field, ...]] = []
        if loaded:
            moved.append(_pushed(vector, radii, viscosity, rotational, load))
        if rate is not None:
            moved.append(_disturbance(vector, radii, rate, rotational))
        return tuple(reduce(jnp.add, parts) for parts in zip(*moved, strict=True))

    rate = None if strain is None else strain(position)
    units = jnp.eye(dim, dtype=position.dtype)[:, :, None, None]
    along = [jnp.broadcast_to(units[:, c], (dim, *d.shape)) for c, d in enumerate(vectors)]
    slopes = jax.vmap(jax.linearize(lambda v: pairs(v, rate), vectors)[1])(along)
    own = [f.sum(axis=2) for f in slopes]
    if strain is not None and rate is not None and rate.ndim == 3:
        # The strain at bead j changes with its place.
        shift = jnp.broadcast_to(units[:, None, :, 0, 0], (dim, *position.shape))
        slope = jax.vmap(jax.linearize(strain, position)[1])(shift)
        others = jax.vmap(lambda e: _disturbance(vectors, radii, e, rotational))(slope)
        slopes = [f - g for f, g in zip(slopes, others, strict=True)]
    total = [
        jnp.einsum("sic,ci->si", shifts, o) - jnp.einsum("sjc,cij->si", shifts, f)
        for o, f in zip(own, slopes, strict=True)
    ]
    velocity = jnp.stack(total[:dim], axis=2)
    return Motion(velocity, jnp.stack(total[dim:], axis=2) if rotational else None)
