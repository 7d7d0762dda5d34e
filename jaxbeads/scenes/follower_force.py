"""Clamped filament under a follower force: flutter."""

import numpy as np

from .._checks import finite, positive, whole
from ..chain import Chain, from_tangents
from ..constraint import Gears, PrescribedPosition, clamped
from ..force import Bending, Follower
from ..mobility import RPY, AbstractMobility
from ..scene import Scene
from ..solution import Solution
from ..state import State
from .case import Case, ReadyMade, Value, lateral_modes

__all__ = ["FOLLOWER_FORCE", "follower_force", "growth_rates"]

_RPY = RPY()


def follower_force(
    beads: int = 20,
    force: float = 60.0,
    *,
    hinged: bool = False,
    mobility: AbstractMobility = _RPY,
    radius: float = 1.0,
    viscosity: float = 1.0,
    rigidity: float = 1.0,
    perturbation: float = 1e-3,
) -> Case:
    """A Gears filament, clamped at its first bond, with a compressive force along its last bond.

    It starts straight but for a small bend and is followed until a growing
    deflection is fully developed.

    **Arguments**: number of beads (at least 5); force as P L^2/K_b, L = 2 a N; `hinged`: the first
    bead is held but free to turn; mobility; a [length]; mu; K_b; slope of the start's bend [rad].

    **Raises** `ValueError` for too few beads and numbers that are out of range.

    >>> from jaxbeads import scenes
    >>> case = scenes.follower_force(beads=5, force=60.0)
    >>> follower = next(f for f in case.scene.forces if type(f).__name__ == "Follower")
    >>> print(follower.force)  # 60 K_b/L^2, L = 10
    0.6
    """
    whole("beads", beads, 5)
    finite("force", force)
    positive("rigidity", rigidity)
    positive("perturbation", perturbation)
    chain = Chain(radius, beads)
    length = float(chain.length[0])
    push = Follower(force * rigidity / length**2)
    ends = (PrescribedPosition(),) if hinged else clamped()
    scene = Scene(
        chain,
        viscosity,
        mobility=mobility,
        constraints=(Gears(), *ends),
        forces=[Bending(rigidity), push],
    )
    slope = perturbation * np.linspace(0, 1, beads - 1) ** 2
    position = np.asarray(from_tangents(chain, np.stack([np.cos(slope), np.sin(slope)], axis=1)))
    state = State(position - position[0])
    growth = abs(float(np.real(growth_rates(scene)[0])))
    unit = viscosity * length**4 / rigidity
    span = min(3 * np.log(1 / perturbation) / max(growth, 1e-12 / unit), 3.0 * unit)
    return Case(scene, state, np.linspace(0, span, 401), scales={"rigidity": rigidity})


def growth_rates(scene: Scene) -> np.ndarray:
    """Growth rates of small deflections of the straight filament [1/time], fastest first; their
    imaginary parts are angular frequencies.

    >>> from jaxbeads import scenes
    >>> weak, strong = (scenes.follower_force(beads=5, force=p).scene for p in (10.0, 100.0))
    >>> print(scenes.growth_rates(weak)[0].real < 0 < scenes.growth_rates(strong)[0].real)
    True
    """
    held = 1 if len(scene.constraints) == 2 else 2
    return lateral_modes(scene, held=held)[0]


def _tip(case: Case, solution: Solution) -> np.ndarray:
    return np.asarray(solution.states.position[:, -1, 1] / case.scene.chain.length[0])


def _observables(case: Case, solution: Solution) -> dict[str, Value]:
    scene = case.scene
    unit = float(scene.viscosity * scene.chain.length[0] ** 4 / case.scales["rigidity"])
    late = _tip(case, solution)[len(solution.ts) // 2 :]
    turns = np.sum(late[1:] * late[:-1] < 0)
    return {
        "growth_rate": float(np.real(growth_rates(scene)[0])) * unit,
        "flaps": bool(turns >= 2 and np.abs(late).max() > 0.05),
    }


FOLLOWER_FORCE = ReadyMade(
    "follower-force",
    "clamped filament under a follower force: growth rate of deflections over K_b/(mu L^4), flapping",
    follower_force,
    {"beads": "number of beads", "force": "force as P L^2/K_b"},
    _observables,
    {
        "growth_rate": "of the fastest deflection from straight over K_b/(mu L^4)",
        "flaps": "whether the tip goes on swinging",
    },
    ("lateral position of the tip $y/L$", _tip),
    co_moving=False,
    quick="--beads 6 --force 70.0",
)
