"""Mirror images at a free surface, a flat one without friction: what it adds to the mobility.

The mirrored flow of the mirrored spheres makes a flow with no normal velocity and no shear stress at the
plane. That is exact for what Rotne-Prager-Yamakawa is, also where spheres meet their own images.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .configuration import Configuration
from .domain import AbstractHalfSpace
from .pairs import Field, PairTensor, Radii, Signed, added, pair_sums, radii_of, separations
from .state import Load, Motion, add_motions, spins
from .tensors import as_motion, pushed, rpy, rpy_motion, shear_disturbance, strained


def mirror_of(configuration: Configuration) -> tuple[Array, Array]:
    """Mirror images of the spheres behind a plane, and the mirror I - 2 n n."""
    domain, position = configuration.domain, configuration.position
    if not isinstance(domain, AbstractHalfSpace):
        raise ValueError("Argument `configuration` must be that of a half space, but it is not.")
    n = domain.direction
    images = position - 2 * domain.height(position)[:, None] * n[None]
    return images, jnp.eye(len(n), dtype=position.dtype) - 2 * n[:, None] * n[None, :]


def _from_images(
    configuration: Configuration, fields: Callable[[list[Field], Radii | None], Sequence[Field]]
) -> Motion:
    """Sums over the mirror images j of functions of r_i - r_j."""
    scaled, (images, _) = configuration.scaled, mirror_of(configuration)
    images = images / scaled.length
    if scaled.radius is None:
        sums = pair_sums(
            lambda to, of: fields(separations(to[0], of[1]), None), (scaled.position, images)
        )
    else:
        beads = (scaled.position, images, scaled.radius)
        sums = pair_sums(
            lambda to, of: fields(separations(to[0], of[1]), radii_of(to[2], of[2])), beads
        )
    return as_motion(sums, configuration)


def mirrored_load(load: Load, mirror: Array) -> Load:
    """Forces in a mirror, and torques, which it turns the other way."""
    torque = load.torque
    if torque is not None:
        torque = torque if torque.shape[-1] == 1 else torque @ mirror
        torque = -torque
    return Load(None if load.force is None else load.force @ mirror, torque)


def _motion(configuration: Configuration, load: Load) -> Motion:
    """What a free surface adds to M F: the mirror images of the spheres with the mirrored loads."""
    length, mirror = configuration.scaled.length, mirror_of(configuration)[1]
    viscosity, rotational = configuration.viscosity, configuration.rotational
    load = mirrored_load(load, mirror)
    return _from_images(
        configuration, lambda d, radii: pushed(d, radii, length, viscosity, rotational, load)
    )


def _tables(configuration: Configuration) -> PairTensor:
    """What it adds to M, as fields."""
    scaled, (images, mirror) = configuration.scaled, mirror_of(configuration)
    vector = separations(scaled.position, images / scaled.length)
    radii = None if scaled.radius is None else radii_of(scaled.radius, scaled.radius)
    dim, turns, beads = configuration.dim, spins(configuration.dim), configuration.beads

    def column(load: Load) -> tuple[Field, ...]:
        load = jax.tree.map(lambda x: jnp.broadcast_to(x, (beads, x.shape[1])), load)
        load = mirrored_load(load, mirror)
        viscosity, rotational = configuration.viscosity, configuration.rotational
        return pushed(vector, radii, scaled.length, viscosity, rotational, load)

    by_force = [column(Load(unit[None])) for unit in jnp.eye(dim)]
    tt = tuple(tuple(c[i] for c in by_force) for i in range(dim))
    if not configuration.rotational:
        return PairTensor(tt)
    by_torque = [column(Load(torque=unit[None])) for unit in jnp.eye(turns)]
    tr = tuple(tuple(Signed(c[i]) for c in by_torque) for i in range(dim))
    rt = tuple(tuple(Signed(c[dim + i]) for c in by_force) for i in range(turns))
    return PairTensor(tt, tr, rt, tuple(tuple(c[dim + i] for c in by_torque) for i in range(turns)))


def _disturbance(
    configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
) -> Motion:
    """What it adds to C : E."""
    length, mirror = configuration.scaled.length, mirror_of(configuration)[1]
    rate, rotational = mirror @ strain_rate @ mirror, configuration.rotational
    return _from_images(
        configuration, lambda d, radii: strained(d, radii, length, rate, rotational)
    )


def motion(configuration: Configuration, load: Load) -> Motion:
    """M F below or above a free surface."""
    return add_motions(rpy_motion(configuration, load), _motion(configuration, load))


def disturbance(
    configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
) -> Motion:
    """C : E there."""
    free = shear_disturbance(configuration, strain_rate)
    return add_motions(free, _disturbance(configuration, strain_rate))


def tables(configuration: Configuration) -> PairTensor:
    """M there, as fields."""
    return added(rpy(configuration), _tables(configuration))
