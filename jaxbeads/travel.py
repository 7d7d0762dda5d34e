"""`travel`: the path of an `Assembly`, as a pure function; `Journey`: what it returns.

Poses are integrated by Tsitouras' method (that of `diffrax.Tsit5`), or by the linearly implicit RODAS
where joints are stiff, in steps that a tolerance chooses; joints hold exactly, since a pose has no
numbers in which they could fail. Derivatives, in both modes, are those of the steps that are taken
(`loops`).
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from . import quaternions, rodas
from ._checks import fail, finite, increasing, kind, known, positive, shape, whole
from ._typing import float_array, with_all_digits
from .assembly import Assembly, Pose
from .geometry import norm, unit
from .locomotion import given, turning
from .loops import linked, loop
from .outcome import Outcome
from .programs import reached
from .solution import Solution, name_number
from .solver.watch import Watch
from .state import State

__all__ = ["Journey", "travel"]

_TABLEAU: Any = diffrax.Tsit5.tableau
_ORDERS = 5, 4
"""Of Tsitouras' method, and of the error that RODAS estimates."""
_STAGES = len(_TABLEAU.c) + 1
# Of each stage, shares of the rates before it; the last stage is at the end of the step.
_SHARES = np.zeros((_STAGES, _STAGES))
for _k, _row in enumerate(_TABLEAU.a_lower):
    _SHARES[_k + 1, : _k + 1] = _row
_TIMES = np.concatenate([[0.0], _TABLEAU.c])


class Journey(eqx.Module):
    """Poses over time.

    - `ts`: times, `(times,)`; `poses`: a `Pose` with a leading axis of times.
    - `steps`: attempted steps; `code`: 0 when all went well (see `Outcome`).
    - `step`: length of the next step [time], with which `travel` goes on as if it had not stopped.

    >>> import jaxbeads as jb
    >>> motor = jb.body.Motor(None, 0, axis=[0.0, 0.0, 1.0], rate=2.0)
    >>> spun = jb.Assembly([jb.body.rod(2)], 1.0, joints=[motor])
    >>> journey = jb.travel(spun, spun.drawn, [0.0, 0.5, 1.0])
    >>> print(jb.quaternions.angles(journey.final.turn).round(4), journey.code)
    [[0. 0. 2.]] 0
    """

    ts: Float[Array, " times"]
    poses: Pose
    steps: Int[Array, ""]
    code: Int[Array, ""]
    step: Float[Array, ""]
    implicit: bool = eqx.field(static=True, default=False)

    @property
    def final(self) -> Pose:
        """Pose at the last time."""
        return jax.tree.map(lambda x: x[-1], self.poses)

    def solution(self, assembly: Assembly) -> Solution:
        """The beads over time, as for pictures (of `assembly.chain`), tables and files."""

        def position(pose: Pose) -> Array:
            return assembly.positions(assembly.frames(pose))

        states = jax.vmap(lambda pose: State(position(pose)))(self.poses)
        none, name = jnp.zeros_like(self.ts), "Rosenbrock" if self.implicit else "Tsit5"
        numbers = self.ts, states, self.steps, self.code, None, none
        return Solution(*numbers, method=name_number(name), poses=self.poses)


def travel(
    assembly: Assembly,
    pose: Pose,
    ts: Any,
    *,
    tolerance: Any = 1e-6,
    step: Any = None,
    max_steps: int = 100_000,
    implicit: bool = False,
) -> Journey:
    """Poses at the times `ts`, from `pose` at `ts[0]`.

    Pure: use it under `jax.jit`, `jax.vmap` and derivatives by anything numeric, in both modes. It
    cannot raise while it runs: look at `code`.

    **Arguments**

    - `assembly`, `pose`: the bodies and where they start, as `assembly.drawn`.
    - `ts`: increasing times [time], `(times,)`. Steps end there.
    - `tolerance`: largest error of a step, as a fraction of the longest body's length and in radians.
    - `step`: length of the first step [time]; by default one in which little moves.
    - `max_steps`: the most steps between two times.
    - `implicit`: whether steps are linearly implicit, those of `Rosenbrock`. They cost more, but joints
      may be as stiff as they like: take them for flexible fibres (`body.fibre`).

    Steps end where laws of time decide (`jnp.where`, `jnp.floor`, ...), however short a pulse is. A
    smooth one that is much shorter than a step may be missed: save times near it. Draw bodies near the
    origin of their frame and place them by the pose: what is drawn far away needs short steps.

    **Returns** a `Journey`. **Raises** `ValueError` for input that does not fit.

    >>> import jax
    >>> import jaxbeads as jb
    >>> def fallen(force):
    ...     ball = jb.Assembly([jb.body.sphere(1.0)], viscosity=1.0, force=[[0.0, 0.0, -force]])
    ...     return jb.travel(ball, ball.drawn, [0.0, 2.0]).final.place[0, 2]
    >>> print(f"{fallen(6.0):.4f}, {jax.grad(fallen)(6.0):.4f}")  # -F t/(6 pi mu a), and its derivative
    -0.6366, -0.1061
    """
    kind("assembly", assembly, Assembly)
    assembly.check_pose(pose)
    increasing("ts", ts)
    whole("max_steps", max_steps, 1)
    ts = float_array(ts).astype(pose.turn.dtype)
    tolerance = float_array(tolerance).astype(ts.dtype)
    shape("tolerance", tolerance, ())
    least = 100 * float(jnp.finfo(ts.dtype).eps)
    if known(tolerance) and not least <= np.asarray(tolerance) <= 0.1:
        must = f"lie between {least:.1g} (rounding) and 0.1"
        fail("tolerance", must, f"it is {float(tolerance):g}", "How do I choose a tolerance?")
    finite("pose.turn", pose.turn)
    first = _first_step(ts[0], ts[1] - ts[0], pose, assembly) if step is None else step
    step = float_array(first).astype(ts.dtype)
    shape("step", step, ())
    positive("step", step)
    return _travel(assembly, pose, ts, tolerance, step, max_steps, bool(implicit))


class _Carry(eqx.Module):
    """What goes from step to step."""

    t: Array
    step: Array
    pose: Pose
    code: Array


def _size(assembly: Assembly) -> Array:
    """Length of the longest body."""

    def one(position: Array, radii: Array) -> Array:
        return 2 * jnp.max(norm(position - jnp.mean(position, axis=0, keepdims=True)) + radii)

    return jnp.max(jnp.stack([one(body.position, body.radii) for body in assembly.bodies]))


def _amount(change: Pose, size: Array) -> Array:
    """The largest part of a change of a pose: lengths over a size, turns in radians."""
    moved = jnp.max(norm(change.place), initial=0.0) / size
    return jnp.maximum(moved, 2 * jnp.max(norm(change.turn)))


def _first_step(t: Array, gap: Array, pose: Pose, assembly: Assembly) -> Array:
    """In which nothing moves by more than a hundredth."""
    t, gap, pose, assembly = lax.stop_gradient((t, gap, pose, assembly))
    speed = _amount(turning(t, pose, assembly), _size(assembly))
    return jnp.where(speed > 0, 0.01 / jnp.where(speed > 0, speed, 1.0), gap)


@with_all_digits
@eqx.filter_jit
def _travel(
    assembly: Assembly,
    pose: Pose,
    ts: Array,
    tolerance: Array,
    step: Array,
    max_steps: int,
    implicit: bool,
) -> Journey:
    size, none = lax.stop_gradient(_size(assembly)), jnp.zeros((), int)
    first = linked((pose, lax.stop_gradient(step), none, none), (assembly, pose, ts))

    def interval(carry: Any, span: tuple[Array, Array]) -> tuple[Any, Pose]:
        pose, step, steps, code = carry
        t0, t1 = span
        fixed = assembly, t1, tolerance, size, implicit
        start = none, _Carry(t0, step, pose, code)
        count, end = loop(_unfinished, _attempted, start, fixed, max_steps)
        code = jnp.where((end.t < t1) & (end.code == 0), Outcome.TOO_MANY_STEPS, end.code)
        pose = Pose(end.pose.place, unit(end.pose.turn))
        pose = jax.tree.map(lambda x: jnp.where(code == Outcome.FINE, x, jnp.nan), pose)
        return (pose, end.step, steps + count, code), pose

    last, rest = lax.scan(interval, first, (ts[:-1], ts[1:]))
    poses = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), pose, rest)
    return Journey(ts, poses, last[2], last[3], last[1], implicit)


def _stepped(t: Array, h: Array, pose: Pose, assembly: Assembly) -> tuple[Pose, Pose]:
    """A step of Tsitouras' method of order 5 (2011), and its error."""
    start, whole = ravel_pytree(pose)

    def stage(rates: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        index, shares, share = now
        at = start + h * (shares @ rates)
        rate = turning(t + share * h, whole(at), assembly)
        return rates.at[index].set(ravel_pytree(rate)[0]), at

    rates = jnp.zeros((_STAGES, len(start)), start.dtype)
    shares, times = (jnp.asarray(x, start.dtype) for x in (_SHARES, _TIMES))
    each = jnp.arange(_STAGES), shares, times
    # A loop, so that the equations stand in the program once.
    rates, places = lax.scan(stage, rates, each)
    error = h * (jnp.asarray(_TABLEAU.b_error, start.dtype) @ rates)
    return whole(places[-1]), whole(error)


def _near(pose: Pose, x: Array) -> Pose:
    """The pose at numbers x about one: ways, and for each body the vector r of its turn on by (1, r/2),
    of no particular length.
    """
    ways, turns = jnp.split(x, [pose.place.size])
    turns = jnp.pad(turns.reshape(-1, 3) / 2, ((0, 0), (1, 0)), constant_values=((0, 0), (1, 0)))
    return Pose(pose.place + ways.reshape(-1, 3), quaternions.product(turns, pose.turn))


def _near_rate(t: Array, x: Array, pose: Pose, assembly: Assembly) -> Array:
    """Rate of change of x."""
    moving = turning(t, _near(pose, x), assembly)
    turns = x[pose.place.size :].reshape(-1, 3)
    conjugate = jnp.asarray([[1.0, -1.0, -1.0, -1.0]], pose.turn.dtype)
    back = pose.turn * conjugate / jnp.sum(pose.turn**2, 1, keepdims=True)
    change = quaternions.product(moving.turn, back)
    turns = 2 * change[:, 1:] - change[:, :1] * turns
    return jnp.concatenate([moving.place.ravel(), turns.ravel()])


def _implicit(t: Array, h: Array, pose: Pose, assembly: Assembly) -> tuple[Pose, Pose]:
    """A step of RODAS, and its error. The Jacobian is a matrix for the factor alone: derivatives of the
    step are those of products with it.
    """
    x0 = jnp.zeros(pose.place.size + 3 * len(pose.turn), pose.turn.dtype)
    held = lax.stop_gradient((t, pose, assembly))
    jacobian = jax.jacfwd(lambda x: _near_rate(held[0], x, *held[1:]))(x0)
    units = jnp.where(np.arange(len(x0)) < pose.place.size, _size(held[2]), 1.0)
    factor = rodas.factorised(jacobian, lax.stop_gradient(h), units)

    def rate(t: Array, x: Array) -> Array:
        return _near_rate(t, x, pose, assembly)

    def implicit(u: Array) -> Array:
        return u - h * rodas.GAMMA * jax.jvp(lambda x: rate(t, x), (x0,), (u,))[1]

    def solve(rhs: Array) -> Array:
        return lax.custom_linear_solve(
            implicit, rhs, lambda _, b: factor.solve(b), lambda _, b: factor.transpose_solve(b)
        )

    drift = h * h * jax.jvp(lambda t: rate(t, x0), (t,), (jnp.ones_like(t),))[1]

    def stage(us: Array, row: tuple[Array, ...]) -> tuple[Array, None]:
        index, a, c, alpha, weight = row
        rhs = rodas.GAMMA * (h * rate(t + alpha * h, a @ us) + c @ us + weight * drift)
        return us.at[index].set(solve(rhs)), None

    table = rodas.A, rodas.C, rodas.ALPHA, rodas.DRIFT
    rows = (jnp.arange(6), *(jnp.asarray(row, x0.dtype) for row in table))
    us, _ = lax.scan(stage, jnp.zeros((6, len(x0)), x0.dtype), rows)
    ways, turns = jnp.split(us[5], [pose.place.size])
    error = Pose(ways.reshape(-1, 3), turns.reshape(-1, 3) / 2)
    after = _near(pose, jnp.asarray(rodas.A[5], x0.dtype) @ us + us[5])
    return Pose(after.place, unit(after.turn)), error


def _unfinished(now: Any, fixed: Any) -> Array:
    _, carry = now
    return (carry.t < fixed[1]) & (carry.code == Outcome.FINE)


def _span(carry: _Carry, t1: Array, assembly: Assembly) -> tuple[Array, Array, Array, Array]:
    """Where a step begins, its length, where the next one begins, and whether it is shorter than it
    might be: it ends at t1, and just before laws of time switch, as steps of `rollout` do.
    """
    left = t1 - carry.t
    last = carry.step >= left
    h = jnp.where(last, left, carry.step)
    end = jnp.where(last, t1, carry.t + h)
    held, pose, until, bodies = lax.stop_gradient((carry.t, carry.pose, end, assembly))
    if (timed := _timed(bodies, pose, held)) is None:
        return carry.t, h, end, last
    where: Any = pose
    watch = Watch(bodies.scene, where, timed, None)
    begun, _ = watch.begin(held)
    before, after = watch.end(begun, until, until - begun)
    cut = before < until
    t0 = jnp.where(begun > held, begun, carry.t)
    h = jnp.where(cut, before - t0, end - t0)
    return t0, h, jnp.where(cut, after, end), last | cut


def _timed(assembly: Assembly, pose: Pose, t: Array) -> Any:
    """What laws of time say of bodies that stay where they are; `None` without such laws."""

    def acting(t: Array, pose: Pose) -> list[Array]:
        return jax.tree.leaves(given(t, pose, assembly))

    return acting if any(reached(lambda t: acting(t, pose), t)) else None


@with_all_digits
def _attempted(now: Any, fixed: Any) -> Any:
    """One step, kept or not."""
    (count, carry), (assembly, t1, tolerance, size, implicit) = now, fixed
    t0, h, end, cut = _span(carry, t1, assembly)
    stepped = _implicit if implicit else _stepped
    pose, error = stepped(t0, h, carry.pose, assembly)
    wrong = lax.stop_gradient(_amount(error, size) / tolerance)
    good = jnp.all(jnp.isfinite(pose.turn)) & jnp.all(jnp.isfinite(pose.place))
    outside = assembly.scene.outside(State(assembly.positions(assembly.frames(pose))))
    if outside is not None:
        good = good & ~jnp.any(outside)
    wrong = jnp.where(good & jnp.isfinite(wrong), wrong, jnp.inf)
    keep = wrong <= 1
    factor = jnp.clip(0.9 * jnp.maximum(wrong, 1e-10) ** (-1 / _ORDERS[implicit]), 0.2, 5.0)
    # A step that was shortened to end at a time says little about how long the next one may be.
    following = jnp.where(keep & cut, jnp.maximum(carry.step, h * factor), h * factor)
    following = lax.stop_gradient(following)
    stuck = ~keep & (carry.t + following <= carry.t)
    code = jnp.where(stuck, Outcome.GAVE_UP, carry.code)
    new, old = (end, pose), (carry.t, carry.pose)
    t, pose = jax.tree.map(lambda new, old: jnp.where(keep, new, old), new, old)
    return count + 1, _Carry(t, following, pose, code)
