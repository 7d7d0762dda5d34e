"""`Scene`: the model, all parameters and terms; `check`: whether a state fits it."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ._checks import fail, finite, positive, shape
from ._typing import float_array
from .chain import Chain
from .constraint import AbstractConstraint
from .flow import AbstractFlow, LinearFlow
from .force import AbstractForce, Bending, Weight
from .mobility import RPY, AbstractMobility
from .state import State


class Scene(eqx.Module):
    """Beads in a viscous fluid, with what acts on them. Every number in it is a leaf.

    **Arguments**

    - `chain`: the beads and their radius.
    - `viscosity`: mu [force time/length^2].
    - `mobility`: hydrodynamics; `RPY()` by default.
    - `constraints`, `forces`: any number of terms.
    - `flow`: ambient flow, or `None` for a quiescent fluid.

    A term that is absent costs nothing: without spins in any term the mobility has none.

    **Raises** `ValueError` for a viscosity that is not positive and terms of the wrong kind.
    """

    chain: Chain
    viscosity: Float[Array, ""] = eqx.field(converter=float_array)
    mobility: AbstractMobility = RPY()
    constraints: tuple[AbstractConstraint, ...] = eqx.field(converter=tuple, default=())
    forces: tuple[AbstractForce, ...] = eqx.field(converter=tuple, default=())
    flow: AbstractFlow | None = None

    def __check_init__(self) -> None:
        shape("viscosity", self.viscosity, ())
        positive("viscosity", self.viscosity)
        kinds: Sequence[tuple[str, tuple, type]] = (
            ("constraints", self.constraints, AbstractConstraint),
            ("forces", self.forces, AbstractForce),
        )
        for name, terms, kind in kinds:
            for term in terms:
                if not isinstance(term, kind):
                    fail(name, f"hold {kind.__name__} objects", f"it holds a {type(term).__name__}")

    @property
    def rotational(self) -> bool:
        """Whether spins and torques take part, which any one term may ask for."""
        return any(term.rotational for term in (*self.constraints, *self.forces))


def check(
    scene: Scene, state: State, *, overlap: bool = True, single_precision: bool = False
) -> None:
    """Refuse, in one sentence, a state that the scene cannot be run from.

    **Arguments**

    - `overlap`: whether beads may overlap by more than 1 % of a radius.
    - `single_precision`: whether float32 is meant.

    **Raises** `ValueError`. Values that are being traced are not looked at.
    """
    position, chain = state.position, scene.chain
    if position.dtype != jnp.float64 and not single_precision:
        raise ValueError(
            f"Argument `state` must be in float64, but it is in {position.dtype}: call "
            'jax.config.update("jax_enable_x64", True) before anything else, or ask for less with '
            "single_precision=True."
        )
    beads, dim = position.shape
    if beads != chain.beads:
        fail("state", f"hold the chain's {chain.beads} beads", f"it holds {beads}")
    finite("state.position", position)
    _check_terms(scene, dim)
    tracers = any(isinstance(x, Tracer) for x in (position, chain.radius))
    if not overlap and not tracers:
        x, a = np.asarray(position), np.asarray(chain.radii)
        gap = np.linalg.norm(x[:, None] - x[None], axis=-1) - a[:, None] - a[None, :]
        np.fill_diagonal(gap, np.inf)
        i, j = sorted(int(k) for k in np.unravel_index(np.argmin(gap), gap.shape))
        if gap[i, j] < -0.01 * a.min():
            must = "hold no overlapping beads in this scene"
            fail("state", must, f"beads {i} and {j} overlap by {-gap[i, j]:.3g}")


def _check_terms(scene: Scene, dim: int) -> None:
    joints, beads = max(scene.chain.beads - 2, 0), scene.chain.beads
    for term in scene.forces:
        if isinstance(term, Weight):
            shape("Weight.force", term.force, (dim,), (beads, dim))
        if isinstance(term, Bending):
            shape("Bending.rigidity", term.rigidity, (), (joints,))
            vectors = ((joints, 3),) if dim == 3 else ()
            curvature = term.intrinsic_curvature
            shape("Bending.intrinsic_curvature", curvature, (), (joints,), *vectors)
    if isinstance(scene.flow, LinearFlow):
        shape("LinearFlow.matrix", scene.flow.matrix, (dim, dim))
        if dim == 3:
            trace = jnp.trace(scene.flow.matrix)
            if not isinstance(trace, Tracer) and abs(trace) > 1e-9:
                fail("LinearFlow.matrix", "have no trace (incompressible)", f"it is {trace:g}")
