"""One instant: mobility, constraints, forces and flow meet here, and nowhere else.

The saddle-point system of Delmotte, Climent & Plouraboué (2015), eqs (5), (11)-(17),

    Qdot = M (F + J^T lambda) + V_inf + C:E,   J Qdot + B = 0,

is solved once (`solved`). Its derivatives along anything (`evaluation`), and theirs once more
(`derivative`), are those of its equations at the solution, so they take the factor that there is.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import carried
from ._typing import with_all_digits
from .chain import Chain
from .flow import AbstractFlow
from .flow.base import spin_and_strain, velocity_and_gradient
from .loops import keep
from .mobility import Product
from .saddle import (
    Evaluation,
    Factorised,
    Iterations,
    SaddlePoint,
    Time,
    constraint_map,
    saddle_point,
    slips,
)
from .scene import Scene
from .state import Load, Motion, State, add_loads, add_motions, zero_motion


def applied_load(t: Time, state: State, scene: Scene) -> Load:
    """Sum of the forces' loads [force, force length], without those of the constraints.

    >>> import jaxbeads as jb
    >>> forces = [jb.force.Weight([0.0, -1.0]), jb.force.Follower(2.0)]
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), viscosity=1.0, forces=forces)
    >>> print(jb.dynamics.applied_load(0.0, jb.straight(scene.chain, [1.0, 0.0]), scene).force)
    [[ 0. -1.]
     [ 0. -1.]
     [-2. -1.]]
    """
    return add_loads(*(scene.load_of(k, t, state) for k in range(len(scene.forces))))


def _fluid(flow: AbstractFlow, t: Time, state: State, scene: Scene) -> tuple[Motion, Array]:
    """Motion of the fluid, as the beads feel it, and its rate of strain."""
    velocity, gradient = velocity_and_gradient(
        flow, jnp.asarray(t), state.position, scene.chain.radius
    )
    spin, strain = spin_and_strain(gradient)
    still = zero_motion(state, scene.rotational).spin
    turned = None if still is None else jnp.broadcast_to(spin, still.shape)
    return Motion(velocity, turned), strain


def fluid_motion(t: Time, state: State, scene: Scene) -> Motion:
    """V_inf, the motion of the fluid as the beads feel it [length/time, 1/time].

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), 1.0, flow=jb.flow.Shear(1.0))
    >>> state = jb.straight(scene.chain, [0.0, 1.0])
    >>> print(jb.dynamics.fluid_motion(0.0, state, scene).velocity)
    [[-2.  0.]
     [ 0.  0.]
     [ 2.  0.]]
    """
    if scene.flow is None:
        return zero_motion(state, scene.rotational)
    return _fluid(scene.flow, t, state, scene)[0]


def ambient_motion(t: Time, state: State, scene: Scene) -> Motion | None:
    """V_inf + C : E, the motion of beads without load [length/time, 1/time]; `None` without a flow.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), 1.0, flow=jb.flow.Shear(1.0))
    >>> state = jb.straight(scene.chain, [0.0, 1.0])
    >>> print(jb.dynamics.ambient_motion(0.0, state, scene).velocity[:, 0].round(4))
    [-1.9115  0.      1.9115]
    """
    if scene.flow is None:
        return None
    fluid, strain = _fluid(scene.flow, t, state, scene)
    disturbance = scene.operator(state).disturbance(strain)
    return fluid if disturbance is None else add_motions(fluid, disturbance)


def free_motion(t: Time, state: State, scene: Scene, operator: Product) -> Motion:
    """Velocities and spins of the beads as if nothing held them, M F + V_inf + C : E
    [length/time, 1/time].

    **Arguments**: time, state and scene; M at that state, as `scene.operator(state)`.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=3), 1.0, forces=[jb.force.Weight([0.0, -1.0])])
    >>> state = jb.straight(scene.chain, [1.0, 0.0])
    >>> v = jb.dynamics.free_motion(0.0, state, scene, scene.operator(state)).velocity
    >>> print(v[1, 1] < v[0, 1])  # nothing holds them together: the middle one falls faster
    True
    """
    load, ambient = applied_load(t, state, scene), ambient_motion(t, state, scene)
    if load.force is None and load.torque is None:
        return zero_motion(state, scene.rotational) if ambient is None else ambient
    free = operator.motion(load)
    return free if ambient is None else add_motions(free, ambient)


@with_all_digits
@eqx.filter_jit
def evaluation(t: Time, state: State, scene: Scene, known: "Solved | None") -> Evaluation:
    """As `evaluate`; derivatives of an instant that is `known` take it as it is."""
    return _instant(t, state, scene, known).evaluation


class Solved(NamedTuple):
    """One instant, and what solves for its multipliers. Where it is known already, the derivatives of
    `rate` need nothing else of the saddle-point system.
    """

    evaluation: Evaluation
    solver: Factorised | Iterations | None
    """A constant to all derivatives."""


@eqx.filter_custom_jvp
def _instant(t: Time, state: State, scene: Scene, known: Solved | None) -> Solved:
    return solved(t, state, scene) if known is None else known


@with_all_digits
@eqx.filter_jit
def solved(t: Time, state: State, scene: Scene) -> Solved:
    """One instant, without derivatives."""
    operator = scene.operator(state).kept()
    free = free_motion(t, state, scene, operator)
    if not scene.constraints:
        return Solved(Evaluation(free, _none(state)), None)
    system = saddle_point(t, state, scene, operator)
    return Solved(system.hold(free), system.solver)


@_instant.def_jvp
@with_all_digits
def _instant_jvp(primals: Any, tangents: Any) -> tuple[Solved, Solved]:
    """With multipliers and motion held, dQdot = d[M (F + J^T lambda) + V_inf + C:E] + M J^T dlambda and
    J dQdot = -(dJ Qdot + dB): derivatives in either mode take the factor that there is. Second
    derivatives take this rule again.
    """
    t, state, scene, known = primals
    found = _instant(t, state, scene, known)
    if known is None:
        found = keep(found)
    at = t, state, scene, found.evaluation
    shift = *tangents[:3], _nothing(found.evaluation)
    constant = _nothing(found.solver)
    return found, Solved(_answered(at, found.solver, _shifted(at, shift)), constant)


def _nothing(tree: Any) -> Any:
    """No change of anything."""
    return jax.tree.map(lambda _: None, tree)


_At = tuple[Time, State, Scene, Evaluation]
"""An instant with its solution."""


def _held(t: Time, state: State, scene: Scene, evaluation: Evaluation) -> tuple[Motion, Array]:
    """M (F + J^T lambda) + V_inf + C:E and J Qdot + B for any Qdot and lambda, in a form to be
    differentiated: at the solution these are Qdot and 0.
    """
    moved, multipliers = evaluation
    load = applied_load(t, state, scene)
    if not scene.constraints:
        return _pushed(t, state, scene, load), _none(state)
    load = add_loads(load, constraint_map(t, state, scene).pull(multipliers))
    return _pushed(t, state, scene, load), slips(t, state, scene)(moved)


def _shifted(at: _At, shift: Any) -> tuple[Motion, Array]:
    """The derivative of `_held`; no shift (`None`) is no derivative."""
    _, state, scene, evaluation = at
    still = zero_motion(state, scene.rotational), jnp.zeros_like(evaluation.multipliers)
    return eqx.combine(eqx.filter_jvp(_held, at, shift)[1], still)


def _answered(
    at: _At, solver: Factorised | Iterations | None, moved: tuple[Motion, Array]
) -> Evaluation:
    """The change of a solution whose motion and slip would change by `moved`, if multipliers did not."""
    (t, state, scene, _), (motion, slip) = at, moved
    if solver is None:
        return Evaluation(motion, slip)
    # Not by tables, which the backward pass would have to make again.
    system = SaddlePoint(scene.operator(state), constraint_map(t, state, scene), solver)
    change = system.multipliers(slip + system.constraints.linear(motion))
    return Evaluation(add_motions(motion, system.pulled(change)), change)


@with_all_digits
@eqx.filter_jit
def derivative(
    t: Time,
    state: State,
    scene: Scene,
    found: Evaluation,
    solver: Factorised | Iterations | None,
    along: tuple[Array, State],
) -> Motion:
    """Derivative of the motion of an instant that is `found`, along a time and a change of the state, in
    a form to be differentiated once more.
    """
    return _derivative((t, state, scene, found), solver, along).motion


@eqx.filter_custom_jvp
def _derivative(
    at: _At, solver: Factorised | Iterations | None, along: tuple[Array, State]
) -> Evaluation:
    return _answered(at, solver, _shifted(at, (*along, *_nothing(at[2:]))))


@_derivative.def_jvp
@with_all_digits
def _derivative_jvp(primals: Any, tangents: Any) -> tuple[Evaluation, Evaluation]:
    """With K z = b for the saddle-point system, K z_uv = -(second derivative of K z - b along (x_u, z_u)
    and (x_v, z_v)): no solution is differentiated.
    """
    at, solver, along = primals
    found = _derivative(*primals)

    def shifted(at: _At, along: tuple[Array, State]) -> tuple[Motion, Array]:
        return _shifted(at, (*along, _nothing(at[2]), found))

    still = zero_motion(at[1], at[2].rotational), jnp.zeros_like(found.multipliers)
    moved = eqx.filter_jvp(shifted, (at, along), (tangents[0], tangents[2]))[1]
    return found, _answered(at, solver, eqx.combine(moved, still))


def _none(state: State) -> Array:
    return jnp.zeros((0,), state.position.dtype)


def _pushed(t: Time, state: State, scene: Scene, load: Load) -> Motion:
    """M F + V_inf + C:E, in a form to be differentiated."""
    ambient = ambient_motion(t, state, scene)
    if load.force is None and load.torque is None:
        return zero_motion(state, scene.rotational) if ambient is None else ambient
    motion = scene.operator(state).motion(load)
    return motion if ambient is None else add_motions(motion, ambient)


def rate(t: Time, state: State, scene: Scene, known: Solved | None = None) -> State:
    """Time derivative of the state: the right-hand side that the solvers integrate, eqs (38), (48).
    Derivatives of an instant that is `known` take it as it is.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> weight = jb.force.Weight([0.0, -6 * jnp.pi])
    >>> scene = jb.Scene(jb.Chain(radius=1.0, fibres=1), viscosity=1.0, forces=[weight])
    >>> print(jb.dynamics.rate(0.0, jb.State([[0.0, 0.0]]), scene).position.round(12))
    [[ 0. -1.]]
    """
    moved = evaluation(jnp.asarray(t), state, scene, known).motion
    return moving(state, moved, scene.chain, scene.own_rate(t, state))


def moving(state: State, moved: Motion, chain: Chain, own: Any = None) -> State:
    """Rate of change of a state in a motion, and of what forces own."""
    change = carried.moving(state, moved, chain)
    return change if own is None else eqx.tree_at(lambda s: s.own, change, own)
