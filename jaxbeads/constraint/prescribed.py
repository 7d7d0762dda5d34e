"""Prescribed motion: a bead's place or spin, a bond's direction, all bonds' lengths follow a law of
time.

A law is a function of the time; its derivative is found by automatic differentiation. A law that is a
pytree (as those in `jaxbeads.actuation`) keeps its parameters as leaves. Only independent rows are
added: a bond has a prescribed direction in its dim - 1 normal components, because a chain constraint
already keeps its length (the set (65) of the paper has one row too many).
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import index, law, whole
from .._typing import leaf_function
from ..chain import Chain
from ..geometry import bonds, norm, normals, tangents, unit
from ..state import Motion, State, spins
from .base import AbstractConstraint

Law = Callable[[Array], Array]


def _law(function: Any) -> Any:
    return None if function is None else leaf_function(function)


def _rate(law: Law, t: Float[Array, ""]) -> Array:
    """Time derivative of a law."""
    return jax.jvp(law, (t,), (jnp.ones_like(t),))[1]


class PrescribedPosition(AbstractConstraint):
    """A bead moves as r(t): v = dr/dt, eqs (59) and (63).

    **Arguments**

    - `law`: function of the time that returns a position, shape `(dim,)` [length]; only its derivative
      is used, so the bead keeps its distance from r. `None`: the bead is held (a tether; under `Gears`
      or `Inextensible` a hinge).
    - `bead`: index of the bead; -1 is the last one.
    """

    rotational: ClassVar[bool] = False
    law: Law | None = eqx.field(converter=_law, default=None)
    bead: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        whole("bead", self.bead, -(10**9))

    @property
    def held(self) -> int:
        """The bead."""
        return self.bead

    def check(self, chain: Chain, dim: int) -> None:
        """A bead of the chain, and a law of the scene's dimension."""
        index("PrescribedPosition.bead", self.bead, chain.beads)
        law("PrescribedPosition.law", self.law, (dim,))

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Velocity of the bead minus that of the law [length/time], `(dim,)`."""
        velocity = motion.velocity[self.bead]
        return velocity if self.law is None else velocity - _rate(self.law, t)


class PrescribedSpin(AbstractConstraint):
    """A bead spins as w(t).

    **Arguments**

    - `law`: function of the time that returns the spin, shape `(1,)` in the plane and `(3,)` in space
      [1/time]. `None`: no spin.
    - `bead`: index of the bead; -1 is the last one.
    """

    rotational: ClassVar[bool] = True
    turning: ClassVar[bool] = True
    law: Law | None = eqx.field(converter=_law, default=None)
    bead: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        whole("bead", self.bead, -(10**9))

    def check(self, chain: Chain, dim: int) -> None:
        """A bead of the chain, and a law of the scene's dimension."""
        index("PrescribedSpin.bead", self.bead, chain.beads)
        law("PrescribedSpin.law", self.law, (spins(dim),))

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Spin of the bead minus that of the law [1/time], `(spins,)`."""
        if motion.spin is None:
            raise ValueError(
                "Argument `motion` must hold spins for PrescribedSpin, but it holds none."
            )
        spin = motion.spin[self.bead]
        return spin if self.law is None else spin - self.law(t)


class PrescribedDirection(AbstractConstraint):
    """A bond points along e(t): the normal components of (v_{i+1} - v_i) = l de/dt, eqs (61) and (64).

    **Arguments**

    - `law`: function of the time that returns a unit vector, shape `(dim,)`; only its derivative is
      used. `None`: the direction is held.
    - `bond`: index of the bond, from bead `bond` to the next; -1 is the last one.
    """

    rotational: ClassVar[bool] = False
    law: Law | None = eqx.field(converter=_law, default=None)
    bond: int = eqx.field(static=True, default=0)

    def __check_init__(self) -> None:
        whole("bond", self.bond, -(10**9))

    def check(self, chain: Chain, dim: int) -> None:
        """A bond of the chain, and a law of the scene's dimension."""
        index("PrescribedDirection.bond", self.bond, chain.beads - 1)
        law("PrescribedDirection.law", self.law, (dim,))

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Normal velocity of the bond's end about its start minus the law's [length/time],
        `(dim - 1,)`."""
        d = bonds(state.position)[self.bond]
        e, turning = unit(d), bonds(motion.velocity)[self.bond]
        if self.law is not None:
            turning = turning - norm(d) * _rate(self.law, t)
        return normals(e) @ turning


class PrescribedLengths(AbstractConstraint):
    """Bonds that lengthen and shorten as l(t): linked spheres, as the Najafi-Golestanian swimmer.

    **Arguments**

    - `law`: function of the time that returns all bond lengths, shape `(beads - 1,)` [length]; only
      its derivative is used. Entries between two fibres are ignored.
    """

    rotational: ClassVar[bool] = False
    law: Law = eqx.field(converter=leaf_function)

    def check(self, chain: Chain, dim: int) -> None:
        """A length for each bond."""
        law("PrescribedLengths.law", self.law, (chain.beads - 1,))

    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """Rate of each bond's length minus the law's [length/time], of the bonds that exist."""
        stretching = (tangents(state.position) * bonds(motion.velocity)).sum(axis=1)
        return (stretching - _rate(self.law, t))[chain.bond_mask]


def clamped(end: int = 0, *, spinless: bool = False) -> tuple[AbstractConstraint, ...]:
    """Constraints that clamp an end: its bead and the direction of its bond are held.

    **Arguments**

    - `end`: 0 for the first bead, -1 for the last.
    - `spinless`: for scenes without rotation; otherwise the bead's spin is held too, eq. (59).
    """
    held = (PrescribedPosition(bead=end), PrescribedDirection(bond=end))
    return held if spinless else (*held, PrescribedSpin(bead=end))


def hinged(end: int = 0) -> tuple[AbstractConstraint, ...]:
    """Constraints that hinge an end: its bead is held and free to turn."""
    return (PrescribedPosition(bead=end),)
