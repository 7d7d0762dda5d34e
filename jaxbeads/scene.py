"""`Scene`: the model, all parameters and terms; `check`: whether a state fits it."""

import warnings
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._checks import described, fail, finite, kind, known, said
from ._typing import float_array
from .coincidence import overlaid
from .constraint import AbstractChainConstraint, AbstractConstraint, Joint
from .flow import AbstractFlow
from .force import AbstractForce, Bending, BendingEnergy, ElasticRod, JointBending
from .geometry import smallest_gap
from .material import check as check_frames
from .material import with_frames
from .mobility import RPY, AbstractMobility, Operator
from .setting import Setting
from .state import Load, State, check_single

_UNIT = 0.01
"""How far the length of a director may be off one."""


def _terms(terms: Any) -> Any:
    return tuple(terms) if isinstance(terms, Iterable) else terms  # else refused below, by name


class Scene(Setting):
    """Beads in a viscous fluid, with what acts on them. Every number in it is a leaf.

    **Arguments**

    - `chain`: the beads and their radius.
    - `viscosity`: mu [force time/length^2].
    - `mobility`: hydrodynamics; `RPY()` by default.
    - `constraints`, `forces`: any number of terms.
    - `flow`: ambient flow, or `None` for a quiescent fluid.
    - `domain`: the space that fluid and beads are in; unbounded by default.

    A term that is absent costs nothing: without spins in any term the mobility has none.

    **Raises** `ValueError` for a viscosity that is not positive and terms of the wrong kind.

    >>> import jaxbeads as jb
    >>> from jaxbeads.constraint import Gears
    >>> from jaxbeads.force import Bending, Weight
    >>> scene = jb.Scene(
    ...     jb.Chain(radius=1.0, fibres=34),
    ...     viscosity=1.0,
    ...     constraints=[Gears()],
    ...     forces=[Weight([0.0, -1.0]), Bending(157.2)],
    ... )
    >>> print(scene.rotational, scene.forces[1].rigidity)
    True 157.2
    """

    mobility: AbstractMobility = RPY()
    constraints: tuple[AbstractConstraint, ...] = eqx.field(converter=_terms, default=())
    forces: tuple[AbstractForce, ...] = eqx.field(converter=_terms, default=())
    flow: AbstractFlow | None = None

    def __check_init__(self) -> None:
        kind("mobility", self.mobility, AbstractMobility)
        if self.flow is not None:
            kind("flow", self.flow, AbstractFlow)
        _check_kinds("constraints", self.constraints, AbstractConstraint)
        _check_kinds("forces", self.forces, AbstractForce)

    def __str__(self) -> str:
        """What is in it, in a few lines; numbers that are traced are named by their shapes."""
        chain = self.chain
        fibres = "a fibre" if len(chain.fibres) == 1 else f"{len(chain.fibres)} fibres"
        solved = "factorised" if self.dense else "iterated"
        lines = {
            "chain": f"{chain.beads} beads in {fibres}, radius {said(chain.radius)}, "
            f"gap {said(chain.gap)}",
            "fluid": f"viscosity {said(self.viscosity)}, domain {said(self.domain)}, flow "
            f"{'none' if self.flow is None else said(self.flow)}",
            "mobility": f"{said(self.mobility)}, {'with' if self.rotational else 'without'} spins, "
            f"systems are {solved}",
            "constraints": ", ".join(map(said, self.constraints)) or "none",
            "forces": ", ".join(map(said, self.forces)) or "none",
        }
        rows = [f"  {name:<13}{text}" for name, text in lines.items()]
        return "\n".join(["Scene", *rows, "  (`check(scene, state)` says whether a state fits it)"])

    @property
    def rotational(self) -> bool:
        """Whether spins and torques take part, which any one term may ask for."""
        return any(term.rotational for term in (*self.constraints, *self.forces))

    @property
    def oriented(self) -> bool:
        """Whether directors take part, which any one term may ask for."""
        return any(term.oriented for term in (*self.constraints, *self.forces))

    @property
    def dense(self) -> bool:
        """Whether multipliers are found by a factorisation, which implicit solvers need."""
        return self.mobility.is_dense(self.chain.beads)

    def operator(self, state: State) -> Operator:
        """The mobility of the beads where they are."""
        return self.mobility.operator(self.configuration(state, self.rotational))

    def outside(self, state: State) -> Bool[Array, " beads"] | None:
        """Whether the centre of each bead is beyond the domain's boundary; `None` without one."""
        clearance = self.domain.clearance(state.position, self.chain.radius)
        return None if clearance is None else clearance < -self.chain.radius

    def bond_errors(self, state: State) -> Float[Array, " bonds"]:
        """Relative error of each bond length that a chain constraint keeps; 0 of others."""
        every = jnp.zeros(self.chain.beads - 1, state.position.dtype)
        for constraint in self.constraints:
            if isinstance(constraint, AbstractChainConstraint):
                errors = constraint.bond_errors(state, self.chain)
                smaller = jnp.abs(errors) <= jnp.abs(every)  # which what is not a number is not
                every = jnp.where(smaller, every, errors)
        return every

    def begin(self, state: State) -> State:
        """A state with all that the terms need: material frames, and what forces own."""
        planar = state.position.shape[1] == 2
        if not planar and state.frame is None and any(force.needs_frames for force in self.forces):
            state = with_frames(state, self.chain)
        own = self._begun(state)
        if state.own is not None or own is None:
            return state
        return eqx.tree_at(lambda s: s.own, state, own, is_leaf=lambda x: x is None)

    def _begun(self, state: State) -> tuple[Array | None, ...] | None:
        """What the forces own at the start; `None` if nothing."""
        numbers = (force.begin(state, self) for force in self.forces)
        own = tuple(None if x is None else float_array(x) for x in numbers)
        return None if all(x is None for x in own) else own

    def _owning(self, index: int, state: State) -> State:
        """The state as a force sees it, with its own numbers alone."""
        every = self._begun(state) if state.own is None else state.own
        if every is None:
            return state
        return eqx.tree_at(lambda s: s.own, state, every[index], is_leaf=lambda x: x is None)

    def load_of(self, index: int, t: Any, state: State) -> Load:
        """The load of one of the forces."""
        check_single(state)
        return self.forces[index].load(jnp.asarray(t), self._owning(index, state), self)

    def own_rate(self, t: Any, state: State) -> tuple[Array | None, ...] | None:
        """Rate of change of what the forces own [1/time]."""
        if state.own is None:
            return None
        seen = [self._owning(k, state) for k in range(len(self.forces))]
        return tuple(
            None if s.own is None else force.own_rate(jnp.asarray(t), s, self)
            for force, s in zip(self.forces, seen, strict=True)
        )


def _check_kinds(name: str, terms: Any, wanted: type) -> None:
    if not isinstance(terms, tuple):
        fail(name, f"be a list of {wanted.__name__} objects", f"it is {described(terms)}")
    for term in terms:
        if not isinstance(term, wanted):
            hint = " (unpack it with *, as *clamped())" if isinstance(term, tuple) else ""
            fail(name, f"hold {wanted.__name__} objects", f"it holds {described(term)}{hint}")


def in_single(dtype: Any) -> str:
    """What to add to "is not finite" where single precision may be to blame."""
    if dtype == jnp.float64:
        return ""
    return (
        f" in {jnp.dtype(dtype)}, whose numbers end at 3e38 and 1e-38: take float64, or units in which "
        "radius and viscosity are nearer to 1"
    )


def _check_range(scene: Scene) -> None:
    """Refuse mobilities of beads that single precision cannot hold."""
    radius, viscosity = scene.chain.radius, scene.viscosity
    if not known((radius, viscosity)):
        return
    a, mu = np.asarray(radius, float), float(viscosity)
    numbers = {"6 pi mu a": 6 * np.pi * mu * a}
    if scene.rotational:
        numbers["8 pi mu a^3"] = 8 * np.pi * mu * a**3
    for name, value in numbers.items():
        if not np.all((value > 1e-34) & (value < 1e34)):
            must = "be in units that suit single precision (float32), or in float64"
            worst = float(np.ravel(value)[np.argmax(np.abs(np.log(value)))])
            fail("scene", must, f"the friction of a bead, {name}, is {worst:.3g}")


def check(
    scene: Scene, state: State, *, overlap: bool = True, single_precision: bool = False
) -> None:
    """Refuse, in one sentence, a state that the scene cannot be run from.

    **Arguments**

    - `overlap`: whether beads may overlap by more than 1 % of a radius.
    - `single_precision`: whether float32 is meant.

    **Raises** `ValueError`. Warns of fibres with elastic bending that no term holds together. Values
    that are being traced are not looked at.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=[1, 1]), viscosity=1.0)
    >>> try:
    ...     jb.check(scene, jb.State([[0.0, 0.0], [1.0, 0.0]]))
    ... except ValueError as error:
    ...     print(error)
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
    if state.director is not None and known(state.director):
        lengths = np.linalg.norm(np.asarray(state.director), axis=-1)
        off = np.abs(lengths - 1)
        if off.max() > _UNIT:
            must, bead = "hold unit vectors", int(np.argmax(off))
            fail("state.director", must, f"that of bead {bead} has length {lengths[bead]:.3g}")
    if state.director is None and scene.oriented:
        names = [type(t).__name__ for t in (*scene.constraints, *scene.forces) if t.oriented]
        must = f"hold directors for {' and '.join(names)}"
        fail("state", must, "it holds none (`from_directors` makes such a state)")
    check_frames(state, chain)
    if state.frame is not None and not scene.rotational:
        fail("state", "hold no frames", "no term of the scene turns beads")
    _check_own(scene, state)
    for leaf in jax.tree.leaves(scene):
        if position.dtype == jnp.float32 and getattr(leaf, "dtype", None) == jnp.float64:
            fail("scene", "be in float32 as the state is", "it holds numbers in float64")
    if position.dtype == jnp.float32:
        _check_range(scene)
    for term in (*scene.constraints, *scene.forces):
        term.check(chain, dim)
    jointed = any(isinstance(c, Joint) for c in scene.constraints)
    for force in scene.forces:
        if isinstance(force, (Bending, ElasticRod)) and jointed:
            how = f"it holds {type(force).__name__}"
            fail("scene.forces", "bend a chain of Joint with JointBending", how)
        if isinstance(force, JointBending) and not jointed:
            fail("scene.constraints", "hold Joint beside JointBending", "it does not")
    scene.domain.check(dim)
    if scene.flow is not None:
        scene.flow.check(dim)
        scene.domain.check_flow(type(scene.flow).__name__, scene.flow.velocity, dim)
    scene.mobility.check(scene, scene.flow, dim)
    _check_inside(scene, position)
    _warn_of_loose_fibres(scene)
    numbers = known((state, chain))
    if numbers and scene.mobility.interacting and any(c.links for c in scene.constraints):
        how = overlaid(state, chain, oriented=scene.oriented)
        if how is not None:
            fail("state", "hold no bond in the place of another", how)
    if not overlap and numbers and beads > 1:
        radii = np.broadcast_to(np.asarray(chain.radius), beads)
        gap, i, j = smallest_gap(np.asarray(position), radii, scene.domain)
        if gap < -0.01 * radii.min():
            must = "hold no overlapping beads in this scene"
            recipe = "How do I keep beads from passing through one another?"
            fail("state", must, f"beads {i} and {j} overlap by {-gap:.3g}", recipe)


def _check_own(scene: Scene, state: State) -> None:
    """Refuse numbers that the scene's forces do not own."""
    if state.own is None:
        return
    wanted = jax.tree.map(jnp.shape, scene._begun(state))
    given = jax.tree.map(jnp.shape, state.own)
    if given != wanted:
        fail("state.own", f"have the shapes {wanted} of what the forces own", f"it has {given}")


def _check_inside(scene: Scene, position: Array) -> None:
    """Refuse beads that are beyond the boundary of the domain."""
    clearance = scene.domain.clearance(position, scene.chain.radius)
    if clearance is None or not known(clearance):
        return
    height = np.asarray(clearance) + np.asarray(scene.chain.radii)
    if np.any(height < 0):
        bead = int(np.argmin(height))
        must = f"hold beads within the domain {type(scene.domain).__name__}"
        how = f"the centre of bead {bead} lies {-height[bead]:.3g} outside"
        fail("state", must, how, "How do I put it near a wall?")


def _warn_of_loose_fibres(scene: Scene) -> None:
    """Bending holds angles, not distances."""
    chain = scene.chain
    if not chain.joint_mask.any() or any(t.links for t in (*scene.constraints, *scene.forces)):
        return
    for force in scene.forces:
        if not isinstance(force, (Bending, BendingEnergy, ElasticRod)):
            continue
        if known(force.rigidity) and not np.any(np.asarray(force.rigidity)):
            continue
        warnings.warn(
            f"{type(force).__name__} bends fibres whose beads nothing holds together: add a chain "
            "constraint (`Gears`, `Inextensible`), `PrescribedLengths` or `Spring`; a term of your own "
            "that does it says so by `links = True` in its class (`links=True` in `Potential` and "
            "`ForceField`).",
            stacklevel=4,
        )
        return
