"""Images of spheres behind a no-slip wall (`jaxbeads.reflection`): what it adds to the mobility."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import tensors
from .configuration import Configuration
from .domain import NoSlipWall
from .pairs import PairTensor, Signed, added, pair_sums, separations
from .reflection import Pairs, Vector, pairs, reflected, scaled, strained, there, total
from .state import Load, Motion, add_motions, spins


class Spheres(NamedTuple):
    """Some spheres, lengths in units of one: positions, heights, radii."""

    position: Array
    height: Array
    radius: Array


class Wall(NamedTuple):
    """Spheres above a no-slip wall, each at least as high as its radius."""

    configuration: Configuration
    length: Array
    direction: Array
    normal: Vector
    spheres: Spheres

    share: Float[Array, " beads"]
    """By which spheres that overlap the wall are slowed, see `wall`."""

    def slowed(self, tree: Any) -> Any:
        """Loads or motions times the share of each bead."""
        return jax.tree.map(lambda x: self.share[:, None] * x, tree)

    def slowed_tables(self, tables: PairTensor) -> PairTensor:
        """The same of a mobility, from both sides."""
        pairs = self.share[:, None] * self.share[None, :]
        return jax.tree.map(lambda field: pairs * field, tables)

    def _apart(self, to: Spheres, of: Spheres) -> tuple[list[Array], Array]:
        """From the mirror images to the spheres, and that along the normal."""
        images = of.position - 2 * of.height[:, None] * self.direction[None]
        return separations(to.position, images), to.height[:, None] + of.height[None, :]

    def _components(self, velocity: Vector, spin: Vector, like: Array) -> list[Array]:
        dim = self.configuration.dim
        parts = list(velocity[:dim])
        if self.configuration.rotational:
            parts += spin[2:] if dim == 2 else spin
        return [there(x, like) for x in parts]

    def _motion(
        self, fields: Callable[[Spheres, Spheres], list[Array]], to: Spheres | None
    ) -> Motion:
        sums, dim = pair_sums(fields, self.spheres, to), self.configuration.dim
        velocity = jnp.stack(sums[:dim], axis=-1)
        spin = jnp.stack(sums[dim:], axis=-1) if self.configuration.rotational else None
        return Motion(velocity, spin)

    def _pairs(self, to: Spheres, of: Spheres) -> Pairs:
        r, height = self._apart(to, of)
        vector = [*r, *[None] * (3 - len(r))]
        z, a, b = to.height[:, None], to.radius[:, None], of.radius[None, :]
        return pairs(vector, height, self.normal, z, a, b)

    def _loaded(self, pairs: Pairs, force: Vector, torque: Vector) -> list[Array]:
        """What forces and torques on the second spheres do to the first."""
        unit = 1 / (8 * np.pi * self.configuration.viscosity * self.length)
        velocity: list[Vector] = []
        spin: list[Vector] = []
        if any(x is not None for x in force):
            v, w = pairs.by_force(scaled(unit, force))
            velocity.append(v)
            spin.append(scaled(1 / self.length, w))
        if any(x is not None for x in torque):
            v, w = pairs.by_torque(scaled(unit / self.length, torque))
            velocity.append(v)
            spin.append(scaled(1 / self.length, w))
        return self._components(total(*velocity), total(*spin), pairs.force[0])

    def _pushed(self, load: Load) -> Callable[[Spheres, Spheres], list[Array]]:
        """The motions of some spheres under the images of loads on others, as fields."""
        dim = self.configuration.dim

        def rows(x: Array | None) -> Vector:
            return [None] * 3 if x is None else [c[None, :] for c in x.T]

        force = rows(load.force)
        force = [*force[:dim], *[None] * (3 - dim)]
        torque = rows(load.torque)
        torque = torque if len(torque) == 3 else [None, None, *torque]
        return lambda to, of: self._loaded(self._pairs(to, of), force, torque)

    def motion(self, load: Load, to: Spheres | None = None) -> Motion:
        """What the images of loads add to M F, or to the motion of other spheres."""
        return self._motion(self._pushed(load), to)

    def gradient(
        self,
        load: Load,
        lifted: Float[Array, "shifts beads dim"],
        shares: Float[Array, "shifts beads"],
    ) -> Motion:
        """Derivatives of the motion under loads, from those of the spheres' places and shares.

        With f_ij the motion of i by the load on j, sum_j B_i f_ij B_j has the derivative
        sum_j (dB_i f_ij B_j + B_i f_ij dB_j + B_i df_ij B_j), and df_ij is found for each pair once.
        """
        here, spheres, dim = self.configuration, self.spheres, self.configuration.dim
        free = tensors.rpy_gradient(here, self.slowed(load), None, lifted)
        vectors, radii = here.scaled.pairs()
        parts = vectors, radii, self.length, here.viscosity, here.rotational
        images = self._pushed(load)(spheres, spheres)
        pairs = [a + b for a, b in zip(tensors.pushed(*parts, load), images, strict=True)]

        units = jnp.eye(dim, dtype=spheres.position.dtype)
        moved = (
            jnp.broadcast_to(units[:, None], (dim, *spheres.position.shape)),
            jnp.broadcast_to(self.direction[:, None], (dim, len(spheres.height))),
        )
        fields = self._pushed(self.slowed(load))

        def at(to: tuple[Array, Array], of: tuple[Array, Array]) -> list[Array]:
            return fields(Spheres(*to, spheres.radius), Spheres(*of, spheres.radius))

        place = spheres.position, spheres.height
        own = jax.vmap(jax.linearize(lambda x: at(x, place), place)[1])(moved)
        other = jax.vmap(jax.linearize(lambda x: at(place, x), place)[1])(moved)
        shifts = lifted / self.length
        total = tensors.as_motion(
            [
                jnp.einsum("sic,ci->si", shifts, mine.sum(axis=2))
                + jnp.einsum("sjc,cij->si", shifts, others)
                + jnp.einsum("sj,ij->si", shares, pair)
                for mine, others, pair in zip(own, other, pairs, strict=True)
            ],
            here,
        )
        still = tensors.as_motion([(pair @ self.share)[None] for pair in pairs], here)
        turned = jax.tree.map(lambda x: shares[:, :, None] * x, still)
        return add_motions(jax.vmap(self.slowed)(add_motions(free, total)), turned)

    def tables(self) -> PairTensor:
        """What they add to M, as fields."""
        dim, turns = self.configuration.dim, spins(self.configuration.dim)
        spheres, rotational = self.spheres, self.configuration.rotational
        one, none = jnp.ones((1, 1), spheres.position.dtype), [None] * 3
        pairs = self._pairs(spheres, spheres)

        def column(force: Vector, torque: Vector) -> list[Array]:
            return self._loaded(pairs, force, torque)

        def unit(k: int) -> Vector:
            return [one if j == k else None for j in range(3)]

        by_force = [column(unit(k), none) for k in range(dim)]
        tt = tuple(tuple(c[i] for c in by_force) for i in range(dim))
        if not rotational:
            return PairTensor(tt)
        by_torque = [column(none, unit(k)) for k in (range(3) if dim == 3 else (2,))]
        tr = tuple(tuple(Signed(c[i]) for c in by_torque) for i in range(dim))
        rt = tuple(tuple(Signed(c[dim + i]) for c in by_force) for i in range(turns))
        return PairTensor(
            tt, tr, rt, tuple(tuple(c[dim + i] for c in by_torque) for i in range(turns))
        )

    def disturbance(
        self, strain_rate: Float[Array, "*beads dim dim"], to: Spheres | None = None
    ) -> Motion:
        """What the images of the spheres' stresslets add to C : E, or to the motion of others."""
        rows = strain_rate if strain_rate.ndim == 2 else strain_rate[None]
        dim = self.configuration.dim

        def fields(to: Spheres, of: Spheres) -> list[Array]:
            r, height = self._apart(to, of)
            e = [[rows[..., i, j] for j in range(dim)] for i in range(dim)]
            source = strained(r, self.normal, e, of.radius[None, :] + 0 * height)
            v, w = reflected(source, to.height[:, None], to.radius[:, None], self.normal)
            return self._components(scaled(self.length, v), w, height)

        return self._motion(fields, to)


def wall(configuration: Configuration) -> Wall:
    """The images behind a no-slip wall, and the configuration that has them.

    They are those of spheres above the wall. One that overlaps it is lifted until it touches, and loads
    on it and its motion are multiplied by its height over its radius, at least 0: with B the diagonal of
    these shares, B M B is as positive as M, and no bead moves through the wall.
    """
    domain = configuration.domain
    if not isinstance(domain, NoSlipWall):
        raise ValueError("Argument `configuration` must be that of a `NoSlipWall`, but it is not.")
    height, normal = domain.height(configuration.position), domain.direction
    lift = jnp.maximum(configuration.radius - height, 0.0)
    share = jnp.clip(height / configuration.radius, 0.0, 1.0)
    lifted = configuration.at(configuration.position + lift[:, None] * normal[None])
    scaled = lifted.scaled
    radius = 1.0 if scaled.radius is None else scaled.radius
    radii = jnp.broadcast_to(jnp.asarray(radius, height.dtype), height.shape)
    components = [*normal, *[None] * (3 - len(normal))]
    spheres = Spheres(scaled.position, (height + lift) / scaled.length, radii)
    return Wall(lifted, scaled.length, normal, components, spheres, share)


def motion(configuration: Configuration, load: Load) -> Motion:
    """M F near a no-slip wall."""
    here = wall(configuration)
    load = here.slowed(load)
    free = tensors.rpy_motion(here.configuration, load)
    return here.slowed(add_motions(free, here.motion(load)))


def disturbance(
    configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
) -> Motion:
    """C : E near a no-slip wall."""
    here = wall(configuration)
    free = tensors.shear_disturbance(here.configuration, strain_rate)
    return here.slowed(add_motions(free, here.disturbance(strain_rate)))


def gradient(
    configuration: Configuration, load: Load, shifts: Float[Array, "shifts beads dim"]
) -> Motion:
    """Derivatives of M F along shifts of the positions, with F held, see `tensors.rpy_gradient`."""

    def placed(position: Array) -> tuple[Array, Array]:
        there = wall(configuration.at(position))
        return there.configuration.position, there.share

    _, push = jax.linearize(placed, configuration.position)
    return wall(configuration).gradient(load, *jax.vmap(push)(shifts))


def tables(configuration: Configuration) -> PairTensor:
    """M near a no-slip wall, as fields."""
    here = wall(configuration)
    return here.slowed_tables(added(tensors.rpy(here.configuration), here.tables()))
