"""What a constraint is."""

import abc

import equinox as eqx
from jaxtyping import Array, Float

from ..chain import Chain
from ..state import Motion, State
from ..tensors import PairTensor


class AbstractConstraint(eqx.Module):
    """An affine relation of the beads' velocities and spins: slip = J Qdot + B = 0, eq. (5).

    `slip` is all that a new constraint has to say: J and B follow from it, and with them the
    constraint forces J^T lambda, eqs (11)-(17). It need not be integrable.
    """

    rotational: eqx.AbstractClassVar[bool]
    """Whether `slip` reads spins."""

    @abc.abstractmethod
    def slip(self, t: Float[Array, ""], state: State, motion: Motion, chain: Chain) -> Array:
        """What the constraint sets to zero; affine in `motion`, any shape, independent entries."""


class AbstractChainConstraint(AbstractConstraint):
    """A constraint that links neighbours at fixed distances.

    It knows a direct way to S = J M J^T (any other constraint's is built by columns), and what its
    rows keep when integrated exactly, so that the drift of time stepping can be measured and removed.
    """

    @abc.abstractmethod
    def assemble(
        self, t: Float[Array, ""], state: State, tensor: PairTensor, chain: Chain
    ) -> Float[Array, "rows rows"]:
        """S for the raveled `slip`; only its lower triangle is read."""

    @abc.abstractmethod
    def drift(self, state: State, chain: Chain) -> Float[Array, " bonds"]:
        """Relative error of each bond length; 0 between fibres."""

    @abc.abstractmethod
    def project(self, state: State, chain: Chain) -> State:
        """The state with its bond lengths restored, directions and centres of fibres kept."""
