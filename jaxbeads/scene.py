"""`Scene`: the model, all parameters and terms; `check`: whether a state fits it."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._checks import described, fail, finite, kind, positive, shape
from ._compat import Tracer
from ._typing import float_array
from .chain import Chain
from .constraint import AbstractConstraint, Joint
from .flow import AbstractFlow
from .force import AbstractForce, Bending, JointBending
from .geometry import smallest_gap
from .mobility import RPY, AbstractMobility
from .state import State


def _terms(terms: Any) -> Any:
    return tuple(terms) if isinstance(terms, Iterable) else terms  # else refused below, by name


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
    constraints: tuple[AbstractConstraint, ...] = eqx.field(converter=_terms, default=())
    forces: tuple[AbstractForce, ...] = eqx.field(converter=_terms, default=())
    flow: AbstractFlow | None = None

    def __check_init__(self) -> None:
        shape("viscosity", self.viscosity, ())
        positive("viscosity", self.viscosity)
        kind("chain", self.chain, Chain)
        kind("mobility", self.mobility, AbstractMobility)
        if self.flow is not None:
            kind("flow", self.flow, AbstractFlow)
        _check_kinds("constraints", self.constraints, AbstractConstraint)
        _check_kinds("forces", self.forces, AbstractForce)

    @property
    def rotational(self) -> bool:
        """Whether spins and torques take part, which any one term may ask for."""
        return any(term.rotational for term in (*self.constraints, *self.forces))

    @property
    def oriented(self) -> bool:
        """Whether directors take part, which any one term may ask for."""
        return any(term.oriented for term in (*self.constraints, *self.forces))


def _check_kinds(name: str, terms: Any, wanted: type) -> None:
    if not isinstance(terms, tuple):
        fail(name, f"be a list of {wanted.__name__} objects", f"it is {described(terms)}")
    for term in terms:
        if not isinstance(term, wanted):
            hint = " (unpack it with *, as *clamped())" if isinstance(term, tuple) else ""
            fail(name, f"hold {wanted.__name__} objects", f"it holds {described(term)}{hint}")


def check(
    scene: Scene, state: State, *, overlap: bool = True, single_precision: bool = False
) -> None:
    """Refuse, in one sentence, a state that the scene cannot be run from.

    **Arguments**

    - `overlap`: whether beads may overlap by more than 1 % of a radius.
    - `single_precision`: whether float32 is meant.

    **Raises** `ValueError`. Values that are being traced are not looked at.
    """
    kind("scene", scene, Scene)
    kind("state", state, State)
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
    if state.director is not None and not scene.rotational:
        fail("state", "hold no directors", "no term of the scene turns beads")
    if state.director is None and scene.oriented:
        names = [type(t).__name__ for t in (*scene.constraints, *scene.forces) if t.oriented]
        must = f"hold directors for {' and '.join(names)}"
        fail("state", must, "it holds none (`from_directors` makes such a state)")
    for leaf in jax.tree.leaves(scene):
        if position.dtype == jnp.float32 and getattr(leaf, "dtype", None) == jnp.float64:
            fail("scene", "be in float32 as the state is", "it holds numbers in float64")
    for term in (*scene.constraints, *scene.forces):
        term.check(chain, dim)
    jointed = any(isinstance(c, Joint) for c in scene.constraints)
    for force in scene.forces:
        if isinstance(force, Bending) and jointed:
            fail("scene.forces", "bend a chain of Joint with JointBending", "it holds Bending")
        if isinstance(force, JointBending) and not jointed:
            fail("scene.constraints", "hold Joint beside JointBending", "it does not")
    if scene.flow is not None:
        scene.flow.check(dim)
    tracers = any(isinstance(x, Tracer) for x in (position, chain.radius))
    if not overlap and not tracers and beads > 1:
        radii = np.asarray(chain.radii)
        gap, i, j = smallest_gap(np.asarray(position), radii)
        if gap < -0.01 * radii.min():
            must = "hold no overlapping beads in this scene"
            fail("state", must, f"beads {i} and {j} overlap by {-gap:.3g}")
