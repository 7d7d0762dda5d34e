"""Contact: beads that meet and are no neighbours repel each other."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._checks import non_negative, positive, shape
from .._typing import float_array
from ..domain import AbstractHalfSpace, Unbounded
from ..geometry import norm, unit
from ..neighbours import largest, near_sums
from ..pairs import pair_sums, separations
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce, AbstractTouching, repulsion

Fields = Callable[[tuple[Array, ...], tuple[Array, ...]], list[Array]]


_SOON = 1.5
"""Of pairs that are looked at by an implicit step: distance of the surfaces, over the radius."""


class Contact(AbstractForce):
    """Repulsion along the line of centres between beads of different fibres, and between beads of one
    fibre that are not neighbours; and off the boundary of the domain, if it has one. Its profile over
    the distance of the surfaces is that of eq. (43).

    **Arguments**

    - `strength`: F_0, the force where the surfaces overlap by the roughness [force]; half of it where
      they touch.
    - `roughness`: delta_D, distance of the surfaces at which it sets in [length].
    - `decay`: d_0, length of the exponential growth beyond [length].

    **Raises** `ValueError` for a negative strength and lengths that are not positive.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.force import Contact
    >>> two = jb.Chain(radius=1.0, fibres=[1, 1])
    >>> touching = jb.State([[0.0, 0.0], [2.0, 0.0]])
    >>> repulsion = Contact(strength=3.0, roughness=0.1, decay=0.1)
    >>> print(repulsion.load(jnp.zeros(()), touching, jb.Setting(two, viscosity=1.0)).force)
    [[-1.5  0. ]
     [ 1.5  0. ]]
    """

    rotational: ClassVar[bool] = False
    smooth: ClassVar[bool] = True
    passes: ClassVar[bool] = True
    strength: Float[Array, ""] = eqx.field(converter=float_array)
    roughness: Float[Array, ""] = eqx.field(converter=float_array)
    decay: Float[Array, ""] = eqx.field(converter=float_array)

    def __check_init__(self) -> None:
        for name in ("strength", "roughness", "decay"):
            shape(name, getattr(self, name), ())
        non_negative("strength", self.strength)
        positive("roughness", self.roughness)
        positive("decay", self.decay)

    def passed(self, before: State, after: State, scene: Setting) -> Bool[Array, ""]:
        """Whether two beads come closer on the way than at both ends, by more than half the roughness,
        and repel each other there.
        """
        chain = scene.chain
        index = jnp.arange(chain.beads)
        beads = (
            before.position,
            after.position,
            chain.radii,
            index,
            jnp.asarray(chain.fibre_of_bead),
        )

        def fields(to: tuple[Array, ...], of: tuple[Array, ...]) -> list[Array]:
            start, end = separations(to[0], of[0]), separations(to[1], of[1])
            radii, apart, other = (
                x[:, None] + sign * y[None, :]
                for x, y, sign in zip(to[2:], of[2:], (1, -1, -1), strict=True)
            )
            way = [b - a for a, b in zip(start, end, strict=True)]
            start = scene.domain.nearest(start, 1.0)
            length = sum(x * x for x in way)
            part = -sum(x * a for x, a in zip(way, start, strict=True))
            part = jnp.clip(part / jnp.where(length == 0, 1.0, length), 0.0, 1.0)
            closest, first, last = (
                jnp.sqrt(sum((a + s * x) ** 2 for a, x in zip(start, way, strict=True))) - radii
                for s in (part, 0.0, 1.0)
            )
            missed = closest < jnp.minimum(first, last) - self.roughness / 2
            skip = (jnp.abs(apart) <= 1) & (other == 0)
            return [jnp.where(missed & (closest < self.roughness) & ~skip, 1.0, 0.0)]

        return jnp.any(pair_sums(fields, beads)[0] > 0)

    def load(self, t: Float[Array, ""], state: State, scene: Setting) -> Load:
        """Forces on the beads; but for those of a wall they sum to zero."""
        force = jnp.stack(self._sums(self._pushes(scene), state, scene), axis=1)
        return Load(force=self.strength * (force + self._off_walls(state.position, scene)))

    def local(
        self, t: Float[Array, ""], state: State, scene: Setting
    ) -> Float[Array, "beads dim dim"]:
        """Derivative of the force on each bead by its own place [force/length]."""
        dim, pushes = state.position.shape[1], self._pushes(scene)
        units = jnp.eye(dim, dtype=state.position.dtype)

        def fields(to: tuple[Array, ...], of: tuple[Array, ...]) -> list[Array]:
            def moved(x: Array) -> list[Array]:
                return pushes((x, *to[1:]), of)

            along = (jnp.broadcast_to(unit, to[0].shape) for unit in units)
            return [f for unit in along for f in jax.jvp(moved, (to[0],), (unit,))[1]]

        pairs = jnp.stack(self._sums(fields, state, scene), axis=1)
        walls = [
            jax.jvp(
                lambda x: self._off_walls(x, scene),
                (state.position,),
                (jnp.broadcast_to(unit, state.position.shape),),
            )[1]
            for unit in units
        ]
        return self.strength * (
            jnp.swapaxes(pairs.reshape(-1, dim, dim), 1, 2) + jnp.stack(walls, axis=2)
        )

    def touching(self, state: State, scene: Setting, most: int) -> AbstractTouching:
        """Pairs whose surfaces are nearer than `_SOON` radii and the roughness."""
        radius = jnp.max(scene.chain.radii)
        soon = self.roughness + _SOON * radius

        def nearness(to: tuple[Array, ...], of: tuple[Array, ...]) -> Array:
            d, skip = self._apart(to, of, scene)
            distance = jnp.sqrt(jnp.where(skip, 1.0, sum(x * x for x in d)))
            gap = distance - to[1][:, None] - of[1][None]
            return jnp.where(skip, 0.0, jnp.maximum(soon - gap, 0.0))

        beads, reach = self._beads(state, scene)
        reach = reach + _SOON * radius
        first, second, found = largest(nearness, beads, scene.chain.fibres, reach, most)
        way = unit(_apart(state.position, first, second, scene))
        return _Touching(first, second, way, found > 0, self, scene)

    def _apart(
        self, to: tuple[Array, ...], of: tuple[Array, ...], scene: Setting
    ) -> tuple[list[Array], Bool[Array, "to of"]]:
        """r_i - r_j, and pairs that do not push: neighbours may touch; coincident beads have no line of
        centres.
        """
        d = list(scene.domain.nearest(separations(to[0], of[0]), 1.0))
        apart, other = (x[:, None] - y[None, :] for x, y in zip(to[2:], of[2:], strict=True))
        return d, (jnp.abs(apart) <= 1) & (other == 0) | (sum(x * x for x in d) == 0)

    def _pushes(self, scene: Setting) -> Fields:
        """Force of each bead on each other, over the strength, component by component."""

        def fields(to: tuple[Array, ...], of: tuple[Array, ...]) -> list[Array]:
            d, skip = self._apart(to, of, scene)
            radii = to[1][:, None] + of[1][None, :]
            distance = jnp.sqrt(jnp.where(skip, 1.0, sum(x * x for x in d)))
            push = repulsion(distance - radii, self.roughness, self.decay) / distance
            return [jnp.where(skip, 0.0, push) * x for x in d]

        return fields

    def _sums(self, fields: Fields, state: State, scene: Setting) -> list[Array]:
        """Sums of fields that end at the roughness."""
        beads, reach = self._beads(state, scene)

        def met(to: tuple[Array, ...], of: tuple[Array, ...]) -> Bool[Array, "to of"]:
            d, skip = self._apart(to, of, scene)
            furthest = to[1][:, None] + of[1][None, :] + self.roughness
            return ~skip & ~(sum(x * x for x in d) > furthest**2)  # also where there is NaN

        return near_sums(fields, met, beads, scene.chain.fibres, reach)

    def _beads(self, state: State, scene: Setting) -> tuple[tuple[Array, ...], Array]:
        """Position, radius, number and fibre of each, and how far they reach."""
        chain = scene.chain
        fibre = jnp.asarray(chain.fibre_of_bead)
        beads = state.position, chain.radii, jnp.arange(chain.beads), fibre
        # Images of blocks are not looked for.
        images = not isinstance(scene.domain, (Unbounded, AbstractHalfSpace))
        reach = 2 * jnp.max(chain.radii) + self.roughness
        return beads, jnp.asarray(jnp.inf, reach.dtype) if images else reach

    def _off_walls(self, position: Array, scene: Setting) -> Array:
        """Forces off the boundary, over the strength."""
        gap = scene.domain.clearance(position, scene.chain.radius)
        if gap is None:
            return jnp.zeros_like(position)
        # The way out is where the clearance grows.
        inward = jax.grad(lambda x: jnp.sum(self._clearance(x, scene)))(position)
        return repulsion(gap, self.roughness, self.decay)[:, None] * inward

    @staticmethod
    def _clearance(position: Array, scene: Setting) -> Array:
        clearance = scene.domain.clearance(position, scene.chain.radius)
        return jnp.zeros(len(position)) if clearance is None else clearance


def _apart(
    position: Array, first: Array, second: Array, scene: Setting
) -> Float[Array, "pairs dim"]:
    """r_i - r_j, of nearest images."""
    way = position[first] - position[second]
    return jnp.stack(scene.domain.nearest(list(way.T), 1.0), axis=1)


class _Touching(AbstractTouching):
    """Pairs of `Contact`."""

    first: Int[Array, " pairs"]
    second: Int[Array, " pairs"]
    direction: Float[Array, "pairs dim"]
    there: Bool[Array, " pairs"]
    contact: Contact
    scene: Setting

    def apart(self, position: Float[Array, "beads dim"]) -> Float[Array, "pairs dim"]:
        """r_i - r_j."""
        return _apart(position, self.first, self.second, self.scene)

    def gap(self, position: Float[Array, "beads dim"]) -> Float[Array, " pairs"]:
        """Distances of the surfaces [length]."""
        radii = self.scene.chain.radii
        return norm(self.apart(position)) - radii[self.first] - radii[self.second]

    def push(self, gap: Float[Array, " pairs"]) -> Float[Array, " pairs"]:
        """Repulsion at distances of the surfaces [force]."""
        contact = self.contact
        return contact.strength * repulsion(gap, contact.roughness, contact.decay)

    @property
    def deep(self) -> Float[Array, ""]:
        """Where it is some seven times the strength."""
        return -(self.contact.roughness + 2 * self.contact.decay)
