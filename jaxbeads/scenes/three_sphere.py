"""Three linked spheres (Najafi & Golestanian, 2004)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import fail, positive
from .._typing import float_array
from ..chain import Chain
from ..constraint import PrescribedLengths
from ..scene import Scene
from ..solution import Solution
from ..state import State
from .case import SAMPLES, Case, ReadyMade, Value

__all__ = ["THREE_SPHERE", "Arms", "three_sphere"]


class Arms(eqx.Module):
    """l_k(t) = D + stroke cos(2 pi t - phase_k).

    **Arguments**: `separation` D [length]; `stroke` [length], one for both arms or one each;
    `phase` [rad] of each arm.

    >>> import jax.numpy as jnp
    >>> from jaxbeads.scenes import three_sphere
    >>> arms = three_sphere(separation=10.0, stroke=0.1).scene.constraints[0].law
    >>> print(type(arms).__name__, arms(jnp.array(0.25)).round(6))
    Arms [10. 11.]
    """

    separation: Float[Array, ""] = eqx.field(converter=float_array)
    stroke: Array = eqx.field(converter=float_array)
    phase: Float[Array, "2"] = eqx.field(converter=float_array)

    def __call__(self, t: Float[Array, ""]) -> Float[Array, "2"]:
        """Lengths of the two arms [length]."""
        return self.separation + self.stroke * jnp.cos(2 * np.pi * t - self.phase)


def three_sphere(
    separation: float = 10.0,
    stroke: float = 0.1,
    *,
    phase: float = np.pi / 2,
    radius: float = 1.0,
    viscosity: float = 1.0,
) -> Case:
    """Three spheres in a row whose arms lengthen and shorten as D (1 + stroke cos), a quarter of a
    period apart, for one period (t = 1).

    **Arguments**: mean arm length D over a (arms must not let spheres touch); stroke over D; phase
    of the second arm behind the first [rad]; a [length]; mu.

    **Raises** `ValueError` for spheres that would touch and numbers that are not positive.

    >>> from jaxbeads import scenes
    >>> case = scenes.three_sphere(separation=10.0, stroke=0.1)
    >>> print(case.state.position[:, 0].round(6), case.ts[-1])
    [-10.666667   0.333333  10.333333] 1.0
    """
    positive("separation", separation)
    positive("stroke", stroke)
    if separation * (1 - stroke) < 2:
        must = "be so large that the spheres stay apart, separation (1 - stroke) > 2"
        fail("separation", must, f"separation {separation:g} and stroke {stroke:g} were given")
    mean = separation * radius
    arms = Arms(mean, stroke * mean, [0.0, phase])
    scene = Scene(Chain(radius, 3), viscosity, constraints=[PrescribedLengths(arms)])
    first, second = (float(x) for x in arms(jnp.zeros(())))
    x = np.cumsum([0.0, first, second])
    state = State(jnp.asarray(np.stack([x - x.mean(), np.zeros(3)], axis=1)))
    return Case(scene, state, np.linspace(0, 1, SAMPLES + 1), 50, 1e-7)


def _centre(solution: Solution) -> np.ndarray:
    return np.asarray(solution.states.position)[:, :, 0].mean(axis=1)


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    (constraint,) = case.scene.constraints
    arms = constraint.law if isinstance(constraint, PrescribedLengths) else None
    centre, radius = _centre(solution), float(case.scene.chain.radius)
    moved = centre[-1] - centre[0]
    results: dict[str, Value] = {"displacement": moved / radius, "theory_ratio": None}
    if isinstance(arms, Arms):
        stroke = np.broadcast_to(np.asarray(arms.stroke), 2)
        area = np.pi * stroke[0] * stroke[1] * np.sin(float(arms.phase[1] - arms.phase[0]))
        theory = 7 / 12 * radius / float(arms.separation) ** 2 * area
        results["theory_ratio"] = moved / theory if theory else None
    return results


THREE_SPHERE = ReadyMade(
    "three-sphere",
    "three linked spheres: displacement per cycle, and over (7/12)(a/D^2) times the stroke's area",
    three_sphere,
    {"separation": "mean arm length D over a", "stroke": "amplitude of the arms over D"},
    _observables,
    {
        "displacement": "displacement in a cycle over a",
        "theory_ratio": "displacement over (7/12)(a/D^2) times the stroke's area; none without area",
    },
    ("position of the centre over $a$", lambda c, s: _centre(s) / float(c.scene.chain.radius)),
    co_moving=False,
    quick="--separation 20.0 --stroke 0.2",
)
