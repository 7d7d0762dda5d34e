"""Prescribed motion: a bead's place or spin, a bond's direction, all bonds' lengths follow a law of
time.

A law is a function of the time; its derivative is found by automatic differentiation. A law that is a
pytree (as those in `jaxbeads.actuation`) keeps its parameters as leaves. Only independent rows are
added: a bond has a prescribed direction in its dim - 1 normal components, because a chain constraint
already keeps its length (the set (65) of the paper has one row too many).
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, finite, index, shape, whole
from .._functions import check_law, law_of, leaf_function, rate_of
from .._typing import optional_float_array
from ..chain import Chain, check_bond
from ..geometry import bonds, norm, normals, tangents, unit
from ..material import directions
from ..state import Motion, State, spins
from .base import AbstractConstraint

Law = Callable[[Array], Array]


_ALONG = 1e-6
"""Distance of a bond's direction from its law up to which it counts as the same."""


def _needed(function: Any) -> Any:
    return leaf_function(function, "law")


def _law(function: Any) -> Any:
    return None if function is None else _needed(function)


def _number_or_law(value: Any) -> Any:
    return leaf_function(value, "law") if callable(value) else optional_float_array(value)


Indices = int | tuple[int, ...]


def indices(value: Any) -> Any:
    """One index, or several as a tuple."""
    if isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str):
        return tuple(value.tolist() if isinstance(value, np.ndarray) else value)
    return value


def _every(value: Indices) -> tuple[int, ...]:
    return value if isinstance(value, tuple) else (value,)


def _check_indices(name: str, value: Indices) -> None:
    if not _every(value):
        fail(name, "name at least one", "it is empty")
    for one in _every(value):
        whole(name, one, -(10**9))


def _at(value: Indices) -> Any:
    """What takes one row of an array, or several."""
    return np.array(value) if isinstance(value, tuple) else value


def _size(value: Indices, *size: int) -> tuple[int, ...]:
    """Shape of what a law returns for one, or for several."""
    return (len(value), *size) if isinstance(value, tuple) else size


def _led(name: str, law: Law, t: Array, start: Array, like: Array) -> Array:
    """Where a law has led since the start."""
    now, then = (law_of(name, law, at, like.shape, like.dtype) for at in (t, start))
    return now - then


class PrescribedPosition(AbstractConstraint):
    """A bead moves as r(t): v = dr/dt, eqs (59) and (63).

    **Arguments**

    - `law`: function of the time that returns a position, shape `(dim,)` [length]; only its derivative
      is used, so the bead keeps its distance from r. `None`: the bead is held (a tether; under `Gears`
      or `Inextensible` a hinge).
    - `bead`: index of the bead; -1 is the last one. Of several beads a sequence of indices, with a law
      of shape `(their number, dim)`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import PrescribedPosition
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> shaken = PrescribedPosition(lambda t: jnp.stack([0.0 * t, jnp.sin(2.0 * t)]), bead=0)
    >>> scene = jb.Scene(chain, 1.0, constraints=[shaken])
    >>> print(jb.dynamics.motion(0.0, jb.straight(chain, [1.0, 0.0]), scene).velocity[0].round(12))
    [0. 2.]
    """

    rotational: ClassVar[bool] = False
    law: Law | None = eqx.field(converter=_law, default=None)
    bead: Indices = eqx.field(static=True, converter=indices, default=0)

    def __check_init__(self) -> None:
        _check_indices("bead", self.bead)

    @property
    def anchor(self) -> Indices:
        """The bead, or several."""
        return self.bead

    def check(self, chain: Chain, dim: int) -> None:
        """A bead of the chain, and a law of the scene's dimension."""
        for bead in _every(self.bead):
            index("PrescribedPosition.bead", bead, chain.beads)
        size = _size(self.bead, dim)
        check_law("PrescribedPosition.law", self.law, size, chain.radius.dtype)

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Velocity of the bead minus that of the law [length/time], `(dim,)`."""
        velocity = motion.velocity[_at(self.bead)]
        if self.law is None:
            return velocity
        name, size = "PrescribedPosition.law", velocity.shape
        return velocity - rate_of(name, self.law, t, size, velocity.dtype)

    def off_law(
        self,
        t: Float[Array, ""],
        state: State,
        start: tuple[Float[Array, ""], State],
        chain: Chain,
    ) -> tuple[Array, Array] | None:
        """Its way minus that of the law, and that of the law."""
        if self.law is None:
            return None
        place = state.position[_at(self.bead)]
        led = _led("PrescribedPosition.law", self.law, t, start[0], place)
        return state.position[_at(self.bead)] - start[1].position[_at(self.bead)] - led, led


class PrescribedSpin(AbstractConstraint):
    """A bead spins as w(t).

    **Arguments**

    - `law`: function of the time that returns the spin, shape `(1,)` in the plane and `(3,)` in space
      [1/time]. `None`: no spin.
    - `bead`: index of the bead; -1 is the last one. Of several beads a sequence, as for
      `PrescribedPosition`.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import Gears, PrescribedSpin
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> driven = PrescribedSpin(lambda t: jnp.stack([2.0 + 0.0 * t]), bead=-1)
    >>> scene = jb.Scene(chain, 1.0, constraints=[Gears(), driven])
    >>> print(jb.dynamics.motion(0.0, jb.straight(chain, [1.0, 0.0]), scene).spin[-1].round(12))
    [2.]
    """

    rotational: ClassVar[bool] = True
    turning: ClassVar[bool] = True
    law: Law | None = eqx.field(converter=_law, default=None)
    bead: Indices = eqx.field(static=True, converter=indices, default=0)

    def __check_init__(self) -> None:
        _check_indices("bead", self.bead)

    def check(self, chain: Chain, dim: int) -> None:
        """A bead of the chain, and a law of the scene's dimension."""
        for bead in _every(self.bead):
            index("PrescribedSpin.bead", bead, chain.beads)
        size = _size(self.bead, spins(dim))
        check_law("PrescribedSpin.law", self.law, size, chain.radius.dtype)

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Spin of the bead minus that of the law [1/time], `(spins,)`."""
        if motion.spin is None:
            raise ValueError(
                "Argument `motion` must hold spins for PrescribedSpin, but it holds none."
            )
        spin = motion.spin[_at(self.bead)]
        if self.law is None:
            return spin
        return spin - law_of("PrescribedSpin.law", self.law, t, spin.shape, spin.dtype)


class PrescribedRoll(AbstractConstraint):
    """A bead turns about the fibre as Omega(t): w . t = Omega, with t the fibre's direction there, of a
    fibre in space. Its material frame turns with it, see `material`.

    **Arguments**

    - `law`: Omega [1/time], a number or a function of the time that returns one. `None`: no roll.
    - `bead`: index of the bead; -1 is the last one. Of several beads a sequence of indices, with one
      number for all or one for each; a function returns one for each.
    - `across`: whether spins across the fibre are held as well, as at a clamped end. Leave them free
      where the fibre turns.

    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import Gears, PrescribedRoll
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> scene = jb.Scene(chain, 1.0, constraints=[Gears(), PrescribedRoll(2.0)])
    >>> spin = jb.dynamics.motion(0.0, jb.straight(chain, [0.0, 0.0, 1.0]), scene).spin
    >>> print(spin[0].round(12) + 0.0)
    [0. 0. 2.]
    """

    rotational: ClassVar[bool] = True
    turning: ClassVar[bool] = True
    law: Any = eqx.field(converter=_number_or_law, default=None)
    bead: Indices = eqx.field(static=True, converter=indices, default=0)
    across: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        _check_indices("bead", self.bead)
        if isinstance(self.law, Array):
            finite("law", self.law)

    def check(self, chain: Chain, dim: int) -> None:
        """Beads of the chain that have bonds, in space, and a number for each."""
        if dim != 3:
            fail("state", "be in space for PrescribedRoll", "it is planar (use `PrescribedSpin`)")
        for bead in _every(self.bead):
            index("PrescribedRoll.bead", bead, chain.beads)
            if chain.fibres[chain.fibre_of_bead[bead]] < 2:
                how = f"bead {bead} is all of its fibre, which has no direction"
                fail("PrescribedRoll.bead", "have a bond", how)
        size = _size(self.bead)
        if isinstance(self.law, Array):
            shape("PrescribedRoll.law", self.law, (), size)
        else:
            check_law("PrescribedRoll.law", self.law, size, chain.radius.dtype)

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Spin about the fibre minus that of the law [1/time], `()`; `across`: of all spins, `(3,)`."""
        if motion.spin is None:
            raise ValueError(
                "Argument `motion` must hold spins for PrescribedRoll, but it holds none."
            )
        spin, along = (
            x[_at(self.bead)] for x in (motion.spin, directions(state.position, chain)[1])
        )
        roll = jnp.zeros(_size(self.bead), spin.dtype)
        if isinstance(self.law, Array):
            roll = roll + self.law
        elif self.law is not None:
            roll = law_of("PrescribedRoll.law", self.law, t, roll.shape, roll.dtype)
        if self.across:
            return spin - roll[..., None] * along
        return jnp.sum(spin * along, axis=-1) - roll


class PrescribedDirection(AbstractConstraint):
    """A bond points along e(t): the normal components of (v_{i+1} - v_i) = l de/dt, eqs (61) and (64).

    **Arguments**

    - `law`: function of the time that returns a unit vector, shape `(dim,)`; only its derivative is
      used. `None`: the direction is held.
    - `bond`: index of the bond, from bead `bond` to the next; -1 is the last one. Indices count the
      rows of neighbours of all fibres; one that leads from a fibre to the next is refused. Of several
      bonds a sequence, as for `PrescribedPosition`.

    >>> import jaxbeads as jb
    >>> from jaxbeads.actuation import PlanarBeat
    >>> from jaxbeads.constraint import Inextensible, PrescribedDirection
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> beat = PrescribedDirection(PlanarBeat(amplitude=0.5, angular_frequency=3.0))
    >>> scene = jb.Scene(chain, 1.0, constraints=[Inextensible(), beat])
    >>> v = jb.dynamics.motion(0.0, jb.straight(chain, [1.0, 0.0]), scene).velocity
    >>> print(f"{(v[1] - v[0])[1]:.6f}")  # 2 a alpha_0 zeta
    3.000000
    """

    rotational: ClassVar[bool] = False
    law: Law | None = eqx.field(converter=_law, default=None)
    bond: Indices = eqx.field(static=True, converter=indices, default=0)

    def __check_init__(self) -> None:
        _check_indices("bond", self.bond)

    def check(self, chain: Chain, dim: int) -> None:
        """A bond of the chain, and a law of the scene's dimension."""
        for bond in _every(self.bond):
            check_bond("PrescribedDirection.bond", bond, chain)
        size = _size(self.bond, dim)
        check_law("PrescribedDirection.law", self.law, size, chain.radius.dtype)

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Normal velocity of the bond's end about its start minus the law's [length/time],
        `(dim - 1,)`.
        """
        d = bonds(state.position)[_at(self.bond)]
        e, turning = unit(d), bonds(motion.velocity)[_at(self.bond)]
        if self.law is not None:
            name = "PrescribedDirection.law"
            turning = turning - norm(d)[..., None] * rate_of(name, self.law, t, d.shape, d.dtype)
        return jnp.einsum("...nd,...d->...n", normals(e), turning)

    def off_law(
        self,
        t: Float[Array, ""],
        state: State,
        start: tuple[Float[Array, ""], State],
        chain: Chain,
    ) -> tuple[Array, Array] | None:
        """The way of the bond's end about its beginning minus that of the law, and that of the law, if
        the bond started along it.
        """
        if self.law is None:
            return None
        (before, then), length = start, chain.bond_length[_at(self.bond)]
        now, first = (tangents(s.position)[_at(self.bond)] for s in (state, then))
        name = "PrescribedDirection.law"
        along = norm(first - law_of(name, self.law, before, first.shape, first.dtype)) < _ALONG
        led = _led(name, self.law, t, before, first)
        length = length[..., None]
        return jnp.where(along[..., None], length, 0.0) * (now - first - led), length * led


class PrescribedLengths(AbstractConstraint):
    """Bonds that lengthen and shorten as l(t): linked spheres, as the Najafi-Golestanian swimmer.

    **Arguments**

    - `law`: function of the time that returns all bond lengths, shape `(beads - 1,)` [length]; only
      its derivative is used. Entries between two fibres are ignored.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import PrescribedLengths
    >>> chain = jb.Chain(radius=1.0, fibres=3, gap=1.0)
    >>> arms = PrescribedLengths(lambda t: 4.0 + 0.5 * jnp.stack([jnp.sin(t), jnp.cos(t)]))
    >>> scene = jb.Scene(chain, viscosity=1.0, constraints=[arms])
    >>> v = jb.dynamics.motion(0.0, jb.straight(chain, [1.0, 0.0]), scene).velocity
    >>> print(jnp.diff(v[:, 0]).round(12) + 0.0)  # the first lengthens
    [0.5 0. ]
    """

    rotational: ClassVar[bool] = False
    law: Law = eqx.field(converter=_needed)
    links: ClassVar[bool] = True

    def check(self, chain: Chain, dim: int) -> None:
        """A length for each bond."""
        bonds, dtype = max(chain.beads - 1, 0), chain.radius.dtype
        check_law("PrescribedLengths.law", self.law, (bonds,), dtype)

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Rate of each bond's length minus the law's [length/time], of the bonds that exist."""
        stretching = (tangents(state.position) * bonds(motion.velocity)).sum(axis=1)
        size, dtype = stretching.shape, stretching.dtype
        rate = rate_of("PrescribedLengths.law", self.law, t, size, dtype)
        return (stretching - rate)[chain.bond_mask]

    def off_law(
        self,
        t: Float[Array, ""],
        state: State,
        start: tuple[Float[Array, ""], State],
        chain: Chain,
    ) -> tuple[Array, Array] | None:
        """What the bonds have lengthened minus what the law has, and what the law has."""
        now, first = (norm(bonds(s.position)) for s in (state, start[1]))
        led = _led("PrescribedLengths.law", self.law, t, start[0], now) * chain.bond_mask
        return (now - first) * chain.bond_mask - led, led
