"""`Scene`: the model, all parameters and terms; `check`: whether a state fits it."""

from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ._checks import described, fail, finite, kind, positive, shape
from ._typing import float_array
from .chain import Chain
from .constraint import (
    AbstractConstraint,
    FrozenJoints,
    PrescribedDirection,
    PrescribedLengths,
    PrescribedPosition,
    PrescribedSpin,
)
from .flow import AbstractFlow, LinearFlow
from .force import AbstractForce, Bending, BendingEnergy, JointBending, Spring, Weight
from .mobility import RPY, AbstractMobility
from .state import State, spins


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
            fail(name, f"hold {wanted.__name__} objects", f"it holds {described(term)}")


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
    beads = scene.chain.beads
    bonds, joints = max(beads - 1, 0), max(beads - 2, 0)
    for term in scene.forces:
        name = type(term).__name__
        if isinstance(term, Weight):
            shape("Weight.force", term.force, (dim,), (beads, dim))
        if isinstance(term, (Bending, BendingEnergy, JointBending)):
            number = bonds if isinstance(term, JointBending) else joints
            curvature = term.intrinsic_curvature
            shape(f"{name}.rigidity", term.rigidity, (), (number,))
            spatial = dim == 3 and not isinstance(term, BendingEnergy)
            vectors = ((number, 2), (number, 3)) if spatial else ()
            if callable(curvature):
                along = jnp.zeros(number)
                name_of = f"{name}.intrinsic_curvature"
                curvature = _outcome(name_of, f"{number} joints", curvature, along, along)
            shape(f"{name}.intrinsic_curvature", curvature, (), (number,), *vectors)
        if isinstance(term, Spring):
            shape("Spring.stiffness", term.stiffness, (), (bonds,))
    for term in scene.constraints:
        _check_constraint(term, beads, dim)
    if isinstance(scene.flow, LinearFlow):
        shape("LinearFlow.matrix", scene.flow.matrix, (dim, dim))
        if dim == 3:
            trace, size = jnp.trace(scene.flow.matrix), jnp.max(jnp.abs(scene.flow.matrix))
            if not isinstance(trace, Tracer) and abs(trace) > 1e-6 * size:
                fail("LinearFlow.matrix", "have no trace (incompressible)", f"it is {trace:g}")


def _check_constraint(term: AbstractConstraint, beads: int, dim: int) -> None:
    name = type(term).__name__
    if isinstance(term, FrozenJoints) and dim != 2:
        fail("state", "be planar for FrozenJoints", "it is three-dimensional")
    if isinstance(term, (PrescribedPosition, PrescribedSpin)):
        _check_index(f"{name}.bead", term.bead, beads)
        size = (spins(dim),) if isinstance(term, PrescribedSpin) else (dim,)
        _check_law(name, term.law, size)
    if isinstance(term, PrescribedDirection):
        _check_index(f"{name}.bond", term.bond, beads - 1)
        _check_law(name, term.law, (dim,))
    if isinstance(term, PrescribedLengths):
        _check_law(name, term.law, (beads - 1,))


def _check_index(name: str, index: int, number: int) -> None:
    if not -number <= index < number:
        fail(name, f"lie between {-number} and {number - 1}", f"it is {index}")


def _check_law(name: str, law: Any, size: tuple[int, ...]) -> None:
    if law is not None:
        shape(f"{name}.law", _outcome(f"{name}.law", "a time", law), size)


def _outcome(name: str, given: str, function: Callable[..., Any], *arguments: Array) -> Any:
    """Shape of a user's function of time, without computing anything."""
    try:
        return jax.eval_shape(function, jnp.zeros(()), *arguments)
    except Exception as error:
        first = str(error).strip().splitlines()[0].rstrip(".")
        fail(name, f"be a function that can be called with {given}", f"it raises: {first}")
