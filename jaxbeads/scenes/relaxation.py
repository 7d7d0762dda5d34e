"""Free relaxation of a bent fibre: the decay of one bending mode."""

import numpy as np

from .._checks import fail, positive, whole
from ..chain import Chain, from_tangents
from ..constraint import Gears
from ..force import Bending
from ..scene import Scene
from ..solution import Solution
from ..solver import explicit_step
from ..state import State
from .case import Case, ReadyMade, Value, lateral_modes

__all__ = ["RELAXATION", "relaxation"]


def relaxation(
    beads: int = 34,
    mode: int = 1,
    *,
    radius: float = 1.0,
    viscosity: float = 1.0,
    rigidity: float = 1.0,
    amplitude: float = 1e-4,
) -> Case:
    """A free Gears fibre, bent slightly in one of its bending modes, in a quiescent fluid.

    The mode comes from the linearised motion about the straight shape; it is followed for one decay
    time or 20 000 steps, whichever is shorter.

    **Arguments**: number of beads (at least 4); number of the mode, from 1 to beads - 2; a [length];
    mu; K_b; largest lateral displacement in the mode over the length (the start is centred).

    **Raises** `ValueError` for too few beads, a mode that there is not and an amplitude above 0.01.

    >>> from jaxbeads import scenes
    >>> case = scenes.relaxation(beads=4, mode=1, amplitude=1e-3)
    >>> print(case.state.position[:, 1].round(4))  # a bow
    [ 0.0061 -0.0061 -0.0061  0.0061]
    """
    whole("beads", beads, 4)
    whole("mode", mode, 1)
    if mode > beads - 2:
        fail("mode", f"be at most {beads - 2} (beads - 2)", f"it is {mode}")
    positive("rigidity", rigidity)
    positive("amplitude", amplitude)
    if amplitude > 0.01:
        fail("amplitude", "be small (at most 0.01), for a linear decay", f"it is {amplitude:g}")
    chain = Chain(radius, beads)
    scene = Scene(chain, viscosity, constraints=[Gears()], forces=[Bending(rigidity)])
    growth, shapes = lateral_modes(scene)
    rates = -np.real(growth)[2:]  # the first two are translation and rotation
    shape = np.real(shapes[:, mode + 1])
    shape = shape / np.abs(shape).max()
    rise = amplitude * float(chain.length[0]) * np.diff(shape) / np.asarray(chain.bond_length)
    state = State(from_tangents(chain, np.stack([np.sqrt(1 - rise**2), rise], axis=1)))
    span = min(1 / rates[mode - 1], 20_000 * float(explicit_step(scene)))
    scales = {"rigidity": rigidity}
    return Case(scene, state, np.linspace(0, span, 41), tolerance=1e-6 * amplitude, scales=scales)


def _amplitude(case: Case, solution: Solution) -> np.ndarray:
    y = np.asarray(solution.states.position)[:, :, 1]
    return np.linalg.norm(y - y.mean(axis=1, keepdims=True), axis=1)


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    scene = case.scene
    rate = -np.polyfit(np.asarray(solution.ts), np.log(_amplitude(case, solution)), 1)[0]
    scale = scene.viscosity * scene.chain.length[0] ** 4 / case.scales["rigidity"]
    return {"rate": float(rate * scale)}


RELAXATION = ReadyMade(
    "relaxation",
    "free relaxation of a bending mode: its rate",
    relaxation,
    {"beads": "number of beads", "mode": "number of the bending mode, from 1"},
    _observables,
    {
        "rate": "decay rate of the mode over K_b/(mu L^4)",
    },
    ("amplitude over its start", lambda c, s: _amplitude(c, s) / _amplitude(c, s)[0]),
    stretch=2000.0,
    quick="--beads 5 --mode 2",
)
