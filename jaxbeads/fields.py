"""Velocity of the fluid at points: what spheres drive by their loads and by resisting strain.

A sphere of radius a under the force F and the torque T, in a fluid that is strained at the rate E, adds
at d from its centre, with y = 1/max(|d|, a),

    u = [(y + a^2 y^3/3) F + (1 - a^2 y^2) y^3 (d.F) d + y^3 T x d] / (8 pi mu)
        - a^5 y^5 E.d - (5/2) a^3 y^5 (1 - a^2 y^2) (d.E.d) d

(Kim & Karrila, Microhydrodynamics, section 3.3). Within the sphere that is F/(6 pi mu a) +
T x d/(8 pi mu a^3) - E.d: it moves as a rigid body. Means of u over another sphere's surface are the
Rotne-Prager-Yamakawa mobility and the tensor C. Everything here has three components.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .configuration import Configuration
from .images import Spheres, wall
from .mirror import mirror_of, mirrored_load
from .pairs import CROSS, Field, pair_sums, separations
from .state import Load, Motion

Points = Float[Array, "points 3"]
Strains = Float[Array, "*beads 3 3"]


def _row(vectors: Array) -> list[Array]:
    """Components of each bead's vector, to be multiplied with fields."""
    return [x[None, :] for x in vectors.T]


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence[Array], b: Sequence[Array]) -> list[Array]:
    return [a[j] * b[k] - a[k] * b[j] for _, j, k, sign in CROSS[3] if sign == 1]


def _scaled(configuration: Configuration) -> tuple[Array, Array, Array]:
    """The unit of length; centres and radii in it."""
    scaled = configuration.scaled
    radius = 1.0 if scaled.radius is None else scaled.radius
    ones = jnp.ones(configuration.beads, scaled.position.dtype)
    return scaled.length, scaled.position, radius * ones


def unbounded(
    configuration: Configuration, load: Load, strain_rate: Strains | None, points: Points
) -> Points:
    """The sum over all spheres [length/time], as if there were no boundary.

    **Arguments**: spheres and their loads; the rate of strain that they resist, one for all or one for
    each, or `None`; points [length].
    """
    length, centres, radius = _scaled(configuration)
    unit = 1 / (8 * np.pi * configuration.viscosity * length)

    def fields(to: Array, of: Array) -> list[Field]:
        d, a = separations(to, of), radius[None, :]
        y = 1 / jnp.sqrt(jnp.maximum(_dot(d, d), a * a))
        y3, near = y * y * y, a * a * y * y
        along, parts = jnp.zeros_like(y), []
        if load.force is not None:
            force = _row(unit * load.force)
            along = along + (1 - near) * y3 * _dot(d, force)
            parts.append([(1 + near / 3) * y * f for f in force])
        if load.torque is not None:
            turn = _cross(_row(unit / length * load.torque), d)
            parts.append([y3 * x for x in turn])
        if strain_rate is not None:
            rate = length * strain_rate
            rate = rate[None] if rate.ndim == 2 else rate
            strain = [_dot(_row(rate[:, i]), d) for i in range(3)]
            along = along - 2.5 * a * near * y3 * (1 - near) * _dot(d, strain)
            parts.append([-a * near * near * y * x for x in strain])
        return [sum((p[i] for p in parts), along * d[i]) for i in range(3)]

    return jnp.stack(pair_sums(fields, centres, points / length), axis=-1)


def near_wall(
    configuration: Configuration, load: Load, strain_rate: Strains | None, points: Points
) -> Points:
    """As `unbounded`, with the images behind a no-slip wall: on the wall the fluid is at rest. Spheres
    that overlap the wall push as in the mobility (see `images.wall`).
    """
    here = wall(configuration)
    load = here.slowed(load)
    found = unbounded(here.configuration, load, strain_rate, points)
    apart = (points - here.configuration.position[:1]) @ here.direction
    height = here.spheres.height[0] + apart / here.length
    to = Spheres(points / here.length, height, jnp.zeros_like(height))
    if load.force is not None or load.torque is not None:
        found = found + here.motion(load, to).velocity
    return found if strain_rate is None else found + here.disturbance(strain_rate, to).velocity


def near_surface(
    configuration: Configuration, load: Load, strain_rate: Strains | None, points: Points
) -> Points:
    """As `unbounded`, with the mirror images at a free surface: the fluid slides along it."""
    images, mirror = mirror_of(configuration)
    rate = None if strain_rate is None else mirror @ strain_rate @ mirror
    behind = unbounded(configuration.at(images), mirrored_load(load, mirror), rate, points)
    return unbounded(configuration, load, strain_rate, points) + behind


def within(configuration: Configuration, motion: Motion, points: Points) -> tuple[Array, Points]:
    """How many spheres each point is within, `(points,)`, and the sum of the velocities that it has
    there as a part of them.
    """
    length, centres, radius = _scaled(configuration)
    velocity, spin = motion.velocity, motion.spin

    def fields(to: Array, of: Array) -> list[Field]:
        d = separations(to, of)
        inside = _dot(d, d) < radius[None, :] ** 2
        moved = _row(velocity)
        if spin is not None:
            turn = _cross(_row(length * spin), d)
            moved = [v + w for v, w in zip(moved, turn, strict=True)]
        return [jnp.where(inside, 1.0, 0.0), *(jnp.where(inside, v, 0.0) for v in moved)]

    count, *moved = pair_sums(fields, centres, points / length)
    return count, jnp.stack(moved, axis=-1)
