"""What is optimised: speed, power, efficiency, thrust, pumping, distance, and the distance from data.

Pure functions of a trajectory, to be differentiated, batched and compiled. A periodic motion is
measured over whole periods: give a solution that holds just these, with equal times (a `rollout` from a
`periodic_state`, or `scenes.last_period`). Means over time are by the trapezoidal rule, which then
converges faster than any power of the number of times. A run that broke down (`code` is not 0) has none
of them: they are not a number, lest the best of many runs be one that went wrong.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ._checks import fail, non_zero, positive, shape
from .dynamics import constraint_load
from .geometry import norm
from .observables import power, pumping_rate, swimming_efficiency
from .outcome import Outcome
from .scene import Scene
from .solution import Solution
from .state import State

__all__ = [
    "displacement",
    "distance",
    "efficiency",
    "mean_over_time",
    "mean_power",
    "mean_pumping_rate",
    "pumping_efficiency",
    "shape_error",
    "swimming_speed",
    "thrust",
]


def mean_over_time(function: Callable[..., Any], solution: Solution, scene: Scene) -> Any:
    """Mean of `function(t, state, scene)` over the solution's time: an array or a tree of them.

    It is compiled once for a function and the shapes of solution and scene: a function that is defined
    anew for each call is compiled at each call.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(jb.objectives.mean_over_time(jb.observables.settling_velocity, fall, scene).round(4))
    [ 0.     -0.3183]
    """
    return _of_a_fine_run(solution, _mean(function, solution.ts, solution.states, scene))


def _of_a_fine_run(solution: Solution, values: Any) -> Any:
    """Values that a run gave, or NaN if it broke down."""
    fine = solution.code == Outcome.FINE
    return jax.tree.map(lambda value: jnp.where(fine, value, jnp.nan), values)


@eqx.filter_jit
def _mean(function: Callable[..., Any], ts: Array, states: State, scene: Scene) -> Any:
    gaps = jnp.diff(ts)
    weights = 0.5 * (jnp.pad(gaps, (0, 1)) + jnp.pad(gaps, (1, 0))) / jnp.sum(gaps)
    values = lax.map(lambda at: function(at[0], at[1], scene), (ts, states))
    return jax.tree.map(lambda v: jnp.tensordot(weights, v, axes=1), values)


def displacement(solution: Solution) -> Float[Array, " dim"]:
    """From the mean of all beads at the first time to that at the last [length].

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(jb.objectives.displacement(fall).round(4))  # V t = 2/pi
    [ 0.     -0.6366]
    """
    position = solution.states.position
    moved = jnp.mean(position[-1], axis=0) - jnp.mean(position[0], axis=0)
    return _of_a_fine_run(solution, moved)


def distance(solution: Solution) -> Float[Array, ""]:
    """Net distance travelled by the mean of all beads [length], with derivative 0 at 0.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(f"{jb.objectives.distance(fall):.4f}")
    0.6366
    """
    return norm(displacement(solution))


def swimming_speed(solution: Solution, scene: Scene, frequency: Any) -> Float[Array, ""]:
    """Net speed of the mean of all beads as V/(f L): lengths of the (first) fibre swum in a period.

    **Raises** `ValueError` for a frequency that is not positive.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(f"{jb.objectives.swimming_speed(fall, scene, frequency=1.0):.4f}")  # V/(f 2a)
    0.1592
    """
    positive("frequency", frequency)
    time = solution.ts[-1] - solution.ts[0]
    return distance(solution) / (time * frequency * scene.chain.length[0])


def mean_power(solution: Solution, scene: Scene) -> Float[Array, ""]:
    """Mean work done on the fluid per time, see `observables.power` [force length/time]. In a quiescent
    fluid it is the dissipation; over whole periods, the work of the active torques (and of what
    holds or drives the fibre), because elastic energy comes back.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(f"{jb.objectives.mean_power(fall, scene):.4f}")  # F V = 6/pi
    1.9099
    """
    return mean_over_time(power, solution, scene)


def efficiency(solution: Solution, scene: Scene) -> Float[Array, ""]:
    """Lighthill's efficiency, gamma_par V^2 / P, see `observables.swimming_efficiency`.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(f"{jb.objectives.efficiency(fall, scene):.4f}")  # a bead that is towed
    1.0000
    """
    speed = distance(solution) / (solution.ts[-1] - solution.ts[0])
    return swimming_efficiency(speed, mean_power(solution, scene), scene)


def thrust(solution: Solution, scene: Scene, direction: Any) -> Float[Array, ""]:
    """Mean force of the fibres on what holds them, along a direction [force].

    Forces within chains sum to zero, so this is minus the sum of all constraint forces.

    **Raises** `ValueError` for a direction that is zero or of another dimension.

    >>> import jaxbeads as jb
    >>> weight, hold = jb.force.Weight([0.0, -6.0]), jb.constraint.PrescribedPosition()
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, constraints=[hold], forces=[weight])
    >>> rest = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(f"{jb.objectives.thrust(rest, scene, [0.0, -1.0]):.4f}")
    6.0000
    """
    shape("direction", direction, solution.states.position.shape[-1:])
    non_zero("direction", direction)
    along = jnp.asarray(direction, float)
    return mean_over_time(_held, solution, scene) @ (along / jnp.linalg.norm(along))


def _held(t: Array, state: State, scene: Scene) -> Array:
    """Minus the sum of the constraints' forces."""
    force = constraint_load(t, state, scene).force
    return jnp.zeros_like(state.position[0]) if force is None else -jnp.sum(force, axis=0)


def mean_pumping_rate(solution: Solution, scene: Scene, along: Any) -> Float[Array, ""]:
    """Mean volume of fluid driven along a no-slip wall per time, see `observables.pumping_rate`
    [length^3/time].

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> push, wall = jb.force.Weight([jnp.pi, 0.0]), jb.NoSlipWall([0.0, 0.0], [0.0, 1.0])
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[push], domain=wall)
    >>> run = jb.rollout(scene, jb.State([[0.0, 3.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(f"{jb.objectives.mean_pumping_rate(run, scene, [1.0, 0.0]):.4f}")  # F h/(pi mu)
    3.0000
    """
    rate = jax.tree_util.Partial(_pumped, jnp.asarray(along, float))
    return mean_over_time(rate, solution, scene)


def _pumped(along: Array, t: Array, state: State, scene: Scene) -> Array:
    return pumping_rate(t, state, scene, along)


def pumping_efficiency(solution: Solution, scene: Scene, along: Any) -> Float[Array, ""]:
    """mu Q^2/(n L^3 P) of n cilia at a no-slip wall, with their mean pumping rate Q along a direction,
    their mean power P and the length L of each (n L^3 is the sum of L^3). That of a given sequence of
    shapes depends neither on the viscosity nor on the frequency, and that of cilia far from one another
    not on their number (after Osterman & Vilfan, PNAS 108 (2011) 15727).

    **Raises** `ValueError` for fibres of unequal numbers of beads.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> push, wall = jb.force.Weight([jnp.pi, 0.0]), jb.NoSlipWall([0.0, 0.0], [0.0, 1.0])
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[push], domain=wall)
    >>> run = jb.rollout(scene, jb.State([[0.0, 3.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> print(f"{jb.objectives.pumping_efficiency(run, scene, [1.0, 0.0]):.4f}")
    2.6303
    >>> power = jb.objectives.mean_power(run, scene)
    >>> print(f"{3.0**2 / (2.0**3 * power):.4f}")  # mu Q^2/(L^3 P)
    2.6303
    """
    fibres = scene.chain.fibres
    if len(set(fibres)) > 1:
        fail("scene.chain", "have fibres of one number of beads", f"they have {fibres}")
    both = jax.tree_util.Partial(_pumped_and_used, jnp.asarray(along, float))
    rate, used = mean_over_time(both, solution, scene)
    return scene.viscosity * rate**2 / (jnp.sum(scene.chain.length**3) * used)


def _pumped_and_used(along: Array, t: Array, state: State, scene: Scene) -> tuple[Array, Array]:
    return pumping_rate(t, state, scene, along), power(t, state, scene)


def shape_error(solution: Solution, data: Any, *, moved: bool = False) -> Float[Array, ""]:
    """Root mean square distance of the beads from data [length], with derivative 0 at 0.

    **Arguments**: `data`: positions at the solution's times, `(times, beads, dim)`; `moved`: whether
    each shape is first moved to the data's mean position. **Raises** `ValueError` for data of another
    shape.

    >>> import jaxbeads as jb
    >>> scene = jb.Scene(jb.Chain(1.0, 1), viscosity=1.0, forces=[jb.force.Weight([0.0, -6.0])])
    >>> fall = jb.rollout(scene, jb.State([[0.0, 0.0]]), [0.0, 1.0, 2.0], substeps=1)
    >>> seen = fall.states.position + 0.1  # in both directions
    >>> print(f"{jb.objectives.shape_error(fall, seen):.4f}")
    0.1414
    >>> print(f"{jb.objectives.shape_error(fall, seen, moved=True):.4f}")
    0.0000
    """
    shape("data", data, solution.states.position.shape)
    apart = solution.states.position - jnp.asarray(data)
    if moved:
        apart = apart - jnp.mean(apart, axis=1, keepdims=True)
    error = norm(apart.ravel()) / (apart.shape[0] * apart.shape[1]) ** 0.5
    return _of_a_fine_run(solution, error)
