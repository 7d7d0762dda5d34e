"""What a constraint is."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import fail
from .._compat import custom_vmap, hidden
from ..chain import Chain
from ..geometry import bond_lengths, bonds, unit
from ..pairs import PairTensor
from ..state import Motion, State


class AbstractConstraint(eqx.Module):
    """An affine relation of the beads' velocities and spins: slip = J Qdot + B = 0, eq. (5).

    `slip` is all that a new constraint has to say: J and B follow from it, and with them the
    constraint forces J^T lambda, eqs (11)-(17). It need not be integrable.

    >>> from typing import ClassVar
    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import AbstractConstraint
    >>> class Level(AbstractConstraint):  # both ends are at the same height
    ...     rotational: ClassVar[bool] = False
    ...     def slip(self, t, state, motion, chain):
    ...         return motion.velocity[-1, 1] - motion.velocity[0, 1]
    >>> chain = jb.Chain(radius=1.0, fibres=3)
    >>> weight = jb.force.Weight([[0.0, 0.0], [0.0, 0.0], [0.0, -1.0]])  # of the last bead alone
    >>> scene = jb.Scene(chain, 1.0, constraints=[Level()], forces=[weight])
    >>> v = jb.dynamics.motion(0.0, jb.straight(chain, [1.0, 0.0]), scene).velocity
    >>> print(abs(v[0, 1] - v[2, 1]) < 1e-15)
    True
    """

    rotational: eqx.AbstractClassVar[bool]
    """Whether `slip` reads spins."""
    oriented: ClassVar[bool] = False
    """Whether `slip` reads directors."""
    turning: ClassVar[bool] = False
    """Whether `slip` is a rate of turning [1/time], not a velocity."""
    links: ClassVar[bool] = False
    """Whether it keeps neighbours together."""
    planar: ClassVar[bool] = False
    """Whether it is for planar scenes only."""
    internal: ClassVar[bool] = False
    """Whether it acts between neighbours of a fibre, with no force and no torque in all: a fibre
    carries it along itself. (What `links` does so too.)"""

    @abc.abstractmethod
    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """What the constraint sets to zero; affine in `motion`, any shape, independent entries."""

    @property
    def anchor(self) -> int | tuple[int, ...] | None:
        """Index of a bead, or of several, whose places it prescribes: fibres are placed by them."""
        return None

    def off_law(
        self,
        t: Float[Array, ""],
        state: State,
        start: tuple[Float[Array, ""], State],
        chain: Chain,
    ) -> tuple[Array, Array] | None:
        """How far what it prescribes is from where its law leads since the start (a time and a state),
        and how far the law leads, vectors of any number [length]. `None` if it has no law of places.
        Only a law's derivative is enforced: where the law jumps, nobody follows.
        """
        return None

    def check(self, chain: Chain, dim: int) -> None:
        """Refuse a chain or a dimension that the constraint cannot serve, in one sentence."""
        if self.planar and dim != 2:
            fail("state", f"be planar for {type(self).__name__}", "it is three-dimensional")


class AbstractChainConstraint(AbstractConstraint):
    """A constraint that links neighbours at fixed distances.

    It knows a direct way to S = J M J^T (any other constraint's is built by columns), and what its
    rows keep when integrated exactly, so that the drift of time stepping can be measured and removed.

    >>> from jaxbeads.constraint import AbstractChainConstraint, Gears, PrescribedSpin
    >>> print(isinstance(Gears(), AbstractChainConstraint))
    True
    >>> print(isinstance(PrescribedSpin(), AbstractChainConstraint))
    False
    """

    links: ClassVar[bool] = True

    @abc.abstractmethod
    def assemble(
        self, t: Float[Array, ""], state: State, tensor: PairTensor, chain: Chain
    ) -> Float[Array, "rows rows"]:
        """S for the raveled `slip`; only its upper triangle is read."""

    @abc.abstractmethod
    def bond_errors(self, state: State, chain: Chain) -> Float[Array, " bonds"]:
        """Relative error of each bond length; 0 between fibres."""

    def directions(self, state: State, chain: Chain) -> Float[Array, "directions dim"]:
        """The unit vectors that make the chain's shape: those of its bonds (0 between fibres)."""
        return unit(jnp.where(chain.bond_mask[:, None], bonds(state.position), 0.0))

    def bonds(
        self, direction: Float[Array, "directions dim"], chain: Chain
    ) -> Float[Array, "bonds dim"]:
        """Vectors between neighbours, from the directions."""
        return direction * chain.bond_length[:, None]


def relative_bond_errors(state: State, chain: Chain) -> Float[Array, " bonds"]:
    """Relative error of the distances of neighbours; 0 between fibres."""
    return (bond_lengths(state.position) / chain.bond_length - 1) * chain.bond_mask


Difference = Callable[[Array], Array]


def ends(row: int, column: int) -> Difference:
    """Field of beads -> field of bonds: f_i (+ or -) f_{i+1} along rows and along columns."""

    def apply(f: Array) -> Array:
        corner = f[1:, 1:] if row == column else -f[1:, 1:]
        below = f[1:, :-1] if row == 1 else -f[1:, :-1]
        right = f[:-1, 1:] if column == 1 else -f[:-1, 1:]
        return f[:-1, :-1] + below + right + corner

    return apply


def regular(block: Array, mask: np.ndarray, scale: Array | None) -> Array:
    """A block of S whose rows between two fibres are zero, but for `scale` on the diagonal if given, so
    that S stays regular.
    """
    if mask.all():
        return block
    block = jnp.where(mask[:, None] & mask[None, :], block, 0.0)
    return block if scale is None else block + jnp.diag(~mask * scale)


def kept(function: Difference, one: Array) -> Difference:
    """As `function`, whose result is kept for all that reads it; `one` is a 1 that XLA does not know.
    The function closes over no array, which its rule under `vmap` would find gone.

    XLA: on the CPU it computes what looks cheap anew wherever it is read, but never a quotient; that by
    a number of each member, side by side with others, it makes a product first. There the field that
    goes in is kept: less to compute again, and less to write.
    """

    @custom_vmap
    def apply(field: Array, one: Array) -> Array:
        return function(field) / one

    @apply.def_vmap
    def _(size: int, batched: list[bool], fields: Array, one: Array) -> tuple[Array, bool]:
        return jax.vmap(function)(fields / (1 + 0 * fields)), True

    return lambda field: apply(field, one)


def empty(size: int, dtype: Any) -> Array:
    """A square matrix to be filled by `put_block`."""
    # XLA: hides the zeros, with which it would pad the first block to the whole, number by number; that
    # takes several times as long as any other block.
    return hidden(jnp.zeros((size, size), dtype))


def put_block(matrix: Array, block: Array, row: int, column: int) -> Array:
    """A matrix with a block in its place, the last two axes.

    Many matrices side by side are filled in the same way; the rule of `dynamic_update_slice` would make
    it a scatter, which computes the block's numbers one by one.
    """

    @custom_vmap
    def put(matrix: Array, block: Array) -> Array:
        return lax.dynamic_update_slice(matrix, block, (*[0] * (block.ndim - 2), row, column))

    @put.def_vmap
    def _(size: int, batched: list[bool], matrix: Array, block: Array) -> tuple[Array, bool]:
        matrix, block = (
            x if b else jnp.broadcast_to(x, (size, *x.shape))
            for x, b in zip((matrix, block), batched, strict=True)
        )
        return put_block(matrix, block, row, column), True

    return put(matrix, block)
