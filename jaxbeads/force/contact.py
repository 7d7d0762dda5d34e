"""Contact: beads that meet and are no neighbours repel each other."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._checks import non_negative, positive, shape
from .._typing import float_array
from ..domain import AbstractHalfSpace, Unbounded
from ..pairs import near_sums, pair_sums, separations
from ..setting import Setting
from ..state import Load, State
from .base import AbstractForce, repulsion

Fields = Callable[[tuple[Array, ...], tuple[Array, ...]], list[Array]]


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

    def _pushes(self, scene: Setting) -> Fields:
        """Force of each bead on each other, over the strength, component by component."""

        def fields(to: tuple[Array, ...], of: tuple[Array, ...]) -> list[Array]:
            d = scene.domain.nearest(separations(to[0], of[0]), 1.0)
            radii, apart, other = (
                x[:, None] + sign * y[None, :]
                for x, y, sign in zip(to[1:], of[1:], (1, -1, -1), strict=True)
            )
            square = sum(x * x for x in d)
            # Neighbours may touch; coincident beads have no line of centres.
            skip = (jnp.abs(apart) <= 1) & (other == 0) | (square == 0)
            distance = jnp.sqrt(jnp.where(skip, 1.0, square))
            push = repulsion(distance - radii, self.roughness, self.decay) / distance
            return [jnp.where(skip, 0.0, push) * x for x in d]

        return fields

    def _sums(self, fields: Fields, state: State, scene: Setting) -> list[Array]:
        """Sums of fields that end at the roughness."""
        chain = scene.chain
        fibre = jnp.asarray(chain.fibre_of_bead)
        beads = state.position, chain.radii, jnp.arange(chain.beads), fibre
        if isinstance(scene.domain, (Unbounded, AbstractHalfSpace)):
            reach = 2 * jnp.max(chain.radii) + self.roughness
            return near_sums(fields, beads, chain.fibres, reach)
        return pair_sums(fields, beads)

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
