"""What acts between the ends of a step and is seen by none of its stages.

An error estimate knows the rate at a few instants. What lies between them, a pulse, an obstacle, a jump
of a law, is no error to it: a bead in a still fluid would take ever longer steps, across all of it. Four
things prevent that, and a scene pays for those only that its terms call for:

- terms that depend on the time switch where their program takes another decision (`programs.switches`):
  steps end just before such an instant, and begin just after it;
- what the time and fields in space (`smooth = False`) do to the beads is sampled along the step. What a
  polynomial through a few of the samples misses counts as error of the step;
- so that samples are close, a step spans no more save times and bead radii than `_SAMPLES` allow;
- terms that know better say whether a step has passed them by (`AbstractForce.passed`).

Smooth pulses much shorter than half the interval between save times, and than a step over `_SAMPLES`,
are still missed.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..geometry import norm
from ..programs import reached, switches
from ..scene import Scene
from ..state import Load, State, zero_motion

_SAMPLES = 32  # intervals in a step
_EVERY = 8  # of which so many lie between the samples that are taken to be known


def _interpolation() -> np.ndarray:
    """From the known samples to all: the polynomial through them."""
    x = np.arange(_SAMPLES + 1) / _SAMPLES
    nodes = x[::_EVERY]
    rows = [np.prod([(x - m) / (n - m) for m in nodes if m != n], axis=0) for n in nodes]
    return np.stack(rows, axis=1)


_MATRIX = _interpolation()


def _after(t: Array) -> Array:
    """The next instant but one."""
    return jnp.nextafter(jnp.nextafter(t, jnp.inf), jnp.inf)


Acting = Callable[[Array, State], list[Array]]
"""What something does to the beads at an instant, as velocities [length/time] of any shape."""


class Watch(NamedTuple):
    """Of one step's start; see `watch`."""

    scene: Scene
    state: State
    timed: Acting | None
    """What depends on the time, of beads that stay where they are."""
    placed: Acting | None
    """What depends on the place as well, in ways that are not known to be smooth."""

    @property
    def idle(self) -> bool:
        """Whether neither the time nor the place of a bead matters to any term in unknown ways."""
        return self.timed is None and self.placed is None

    def begin(self, t0: Array) -> tuple[Array, Array]:
        """Where a step from t0 begins, and whether that is on the other side of a switch at t0 itself: a
        step may have ended there by chance, as at a save time, before the terms switched.
        """
        decided = None if self.timed is None else self._decided(self.timed, t0.dtype)
        if decided is None:
            return t0, jnp.zeros((), bool)
        now, then = decided(t0), decided(_after(t0))
        switches = jnp.any((now != then) & ~(jnp.isnan(now) & jnp.isnan(then)))
        return jnp.where(switches, _after(t0), t0), switches

    def end(self, t0: Array, t1: Array, gap: Array) -> tuple[Array, Array]:
        """The last instant before the terms switch, and one just after it; where they do not, t1 twice,
        or an earlier instant if a step to t1 could not be sampled well enough.
        """
        if self.idle:
            return t1, t1
        t1 = jnp.minimum(t1, t0 + _SAMPLES / 2 * gap)
        decided = None if self.timed is None else self._decided(self.timed, t0.dtype)
        if decided is None:
            return t1, t1
        # The start may be the instant of a switch, at which a law may have a value of its own (the slope
        # of a kink, say): what counts is what comes after it.
        first = _after(t0)
        before = decided(first)

        def other(t: Array) -> Array:
            now = decided(t)
            return jnp.any((now != before) & ~(jnp.isnan(now) & jnp.isnan(before)))

        times = first + (t1 - first) * jnp.arange(_SAMPLES + 1, dtype=t0.dtype) / _SAMPLES
        others = lax.map(other, times).at[0].set(False)
        index = jnp.argmax(others)
        bracket = (
            jnp.where(others[index], times[index - 1], t1),
            jnp.where(others[index], times[index], t1),
        )

        def halved(bracket: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = bracket
            middle = low + (high - low) / 2
            beyond = other(middle)
            return jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)

        def open_(bracket: tuple[Array, Array]) -> Array:
            low, high = bracket
            middle = low + (high - low) / 2
            return (low < middle) & (middle < high)

        last, switched = lax.while_loop(open_, halved, bracket)
        return last, jnp.where(switched > last, _after(switched), switched)

    def _decided(self, timed: Acting, dtype: Any) -> Callable[[Array], Array] | None:
        return switches(lambda t: timed(t, self.state), dtype)

    def unseen(
        self, t0: Array, t1: Array, path: Callable[[Array], State]
    ) -> Float[Array, ""] | None:
        """How far beads may be off for what acts between the known samples [length].

        **Arguments**: ends of the step; the states between them, as a function of the time.
        """
        if self.idle:
            return None
        part = jnp.arange(_SAMPLES + 1, dtype=t0.dtype) / _SAMPLES
        # The last sample is the end itself: beyond it terms may have switched.
        times = jnp.minimum(t0 + (t1 - t0) * part, t1)
        rows = []
        if (timed := self.timed) is not None:
            rows += jax.vmap(lambda t: timed(t, self.state))(times)
        if (placed := self.placed) is not None:
            rows += jax.vmap(lambda t: placed(t, path(t)))(times)
        missed = []
        for row in rows:
            flat = row.reshape(len(times), -1)
            off = flat - jnp.asarray(_MATRIX, flat.dtype) @ flat[::_EVERY]
            lengths = norm(off.reshape(len(times), -1, row.shape[-1]))
            missed.append(jnp.max(lengths, axis=1, initial=0.0))
        return (t1 - t0) * jnp.mean(sum(missed[1:], missed[0]))

    def passed(
        self, t0: Array, t1: Array, end: State, path: Callable[[Array], State]
    ) -> Bool[Array, ""]:
        """Whether the step from t0 to t1 leads past something that acts at none of its ends."""
        scene, found = self.scene, jnp.zeros((), bool)
        if self.placed is not None:
            moved = jnp.max(norm(end.position - self.state.position))
            found = found | (moved > _SAMPLES * jnp.min(scene.chain.radius))
        middle = None
        for force in scene.forces:
            if force.passes:
                middle = path(t0 + (t1 - t0) / 2) if middle is None else middle
                found = found | force.passed(self.state, middle, scene)
                found = found | force.passed(middle, end, scene)
        return found


def watch(scene: Scene, t: Array, state: State) -> Watch:
    """What is to be watched in a step from a state. Nothing of it is differentiated: it decides on the
    lengths of steps only.
    """
    t, state, scene = lax.stop_gradient((jnp.asarray(t), state, scene))
    timed: list[Acting] = []
    placed: list[Acting] = []
    for acting, smooth in _terms(scene):
        if not smooth and any(reached(lambda at, a=acting: a(*at), (t, state))):
            placed.append(acting)
        if any(reached(lambda t, a=acting: a(t, state), t)):
            timed.append(acting)
    return Watch(scene, state, _joined(timed), _joined(placed))


def _joined(several: list[Acting]) -> Acting | None:
    if not several:
        return None
    return lambda t, state: [x for acting in several for x in acting(t, state)]


def _terms(scene: Scene) -> list[tuple[Acting, bool]]:
    """What each term of a scene does to the beads, as they would move if each were alone, and whether it
    is known to be smooth in space.
    """
    chain, viscosity = scene.chain, scene.viscosity
    radii = chain.radii[:, None]

    def loaded(load: Load) -> list[Array]:
        found = []
        if load.force is not None:
            found.append(load.force / (6 * np.pi * viscosity * radii))
        if load.torque is not None:
            found.append(load.torque / (8 * np.pi * viscosity * radii**2))
        return found

    def own(rates: Any) -> list[Array]:
        return [jnp.max(chain.length) * x.reshape(-1, 1) for x in jax.tree.leaves(rates)]

    terms: list[tuple[Acting, bool]] = []
    for k, force in enumerate(scene.forces):
        terms.append((lambda t, s, k=k: loaded(scene.load_of(k, t, s)), force.smooth))
    # Numbers of order one, which count as turns of a fibre.
    terms.append((lambda t, s: own(scene.own_rate(t, s)), True))
    for constraint in scene.constraints:
        # A rate of turning moves the end of a fibre.
        arm = jnp.max(chain.length) if constraint.turning else 1.0

        def prescribed(t: Array, s: State, c: Any = constraint, arm: Any = arm) -> list[Array]:
            return [arm * c.slip(t, s, zero_motion(s, scene.rotational), chain)]

        terms.append((prescribed, True))
    if (flow := scene.flow) is not None:
        terms.append(
            (lambda t, s: [jax.vmap(lambda x: flow.velocity(t, x))(s.position)], flow.smooth)
        )
    return terms
