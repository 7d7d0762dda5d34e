"""What a ready-made scene consists of."""

import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import fail
from .._compat import CompileClock
from ..assembly import Assembly, Pose
from ..breakdown import Cause, SimulationError
from ..chain import Chain, straight
from ..coordinates import coordinates
from ..dynamics import motion
from ..geometry import best_rotation
from ..linearise import linearise
from ..locomotion import motion as bodies_at
from ..outcome import Outcome
from ..rollout import Solver, Tolerance, solver_for
from ..scene import Scene
from ..simulate import simulate
from ..solution import Solution
from ..solver import AbstractSolver
from ..state import State
from ..tables import to_csv
from ..travel import Journey, travel

__all__ = [
    "AssemblyCase",
    "Case",
    "ReadyMade",
    "Value",
    "last_period",
    "lateral_modes",
    "modes",
    "whirl",
]

Value = float | Sequence[float] | bool | None
"""A result: a number, several, a yes or no, or none."""


class Case(NamedTuple):
    """A scene with its start: everything that `simulate` needs.

    >>> from jaxbeads import scenes
    >>> case = scenes.settling(beads=3)
    >>> print(case.scene.chain.beads, case.state.position.shape, len(case.ts), case.tolerance)
    3 (3, 2) 1201 1e-06
    """

    scene: Scene
    state: State
    ts: np.ndarray
    """Times to save at [time]."""
    substeps: int | None = None
    """Equal steps between them that suit AB3; `None`: by eq. (39)."""
    tolerance: float = 1e-6
    """Largest error of a step over the fibre's length, for solvers that estimate it."""
    until: Callable[[Solution], bool] | None = None
    """Ends the run early, as at a steady state."""
    chunk: int | None = None
    """Save times between two checks."""
    scales: Mapping[str, float] = MappingProxyType({})
    """What results are measured by, as rigidities and amplitudes, by name."""
    kind: str = ".h5"
    """Of the file that `simulate` writes."""

    def simulate(self, **options: Any) -> Solution:
        """Run it with `jaxbeads.simulate`; options as there (they replace the case's own)."""
        own: dict[str, Any] = {"until": self.until, "chunk": self.chunk, **options}
        solver = self._solver(
            *(own.pop(name, None) for name in ("solver", "tolerance", "substeps"))
        )
        solution = simulate(self.scene, self.state, self.ts, solver=solver, **own)
        if self.until is not None and solution.status == "finished":
            warnings.warn(
                f"The run is not yet steady or periodic at its last time, t = {self.ts[-1]:g}.",
                stacklevel=2,
            )
        return solution

    def _solver(
        self, solver: Solver | None, tolerance: Tolerance | None, substeps: int | None
    ) -> AbstractSolver:
        """The solver that the arguments mean, with the case's steps where they say nothing of steps."""
        meant = solver_for(self.scene, solver, tolerance, substeps)
        options = meant.tolerance, meant.substeps, meant.controller
        if any(option is not None for option in options):
            return meant
        if meant.equal_steps:
            return dataclasses.replace(meant, substeps=self.substeps)
        if meant.estimates_error:
            return dataclasses.replace(meant, tolerance=self.tolerance)
        return meant


class AssemblyCase(NamedTuple):
    """Rigid bodies with their start: everything that `travel` needs. For pictures it is a scene, too.

    >>> from jaxbeads import scenes
    >>> case = scenes.rigid_helix(wavelength=4.0, length=4.0, thickness=0.2)
    >>> print(case.scene.chain.beads, case.state.position.shape, len(case.ts), case.tolerance)
    18 (18, 3) 41 1e-06
    """

    assembly: Assembly
    pose: Pose
    ts: np.ndarray
    """Times to save at [time]."""
    tolerance: float = 1e-6
    """Largest error of a step over the longest body's length, and in radians."""
    scales: Mapping[str, float] = MappingProxyType({})
    """What results are measured by, by name."""
    kind: str = ".csv"
    """Of the file that `simulate` writes."""
    implicit: bool = False
    """Whether steps are implicit, as flexible bodies need them."""

    @property
    def scene(self) -> Scene:
        """The beads, without what holds them together."""
        return self.assembly.scene

    @property
    def state(self) -> State:
        """The beads where they start."""
        return self.assembly.state(self.pose)

    def simulate(
        self,
        *,
        solver: AbstractSolver | None = None,
        tolerance: float | None = None,
        file: str | Path | None = None,
        progress: bool = True,
    ) -> Solution:
        """Run it with `jaxbeads.travel`: the beads over time.

        **Arguments**: the one solver that there is (`Tsit5`; of flexible bodies `Rosenbrock`) or `None`;
        tolerance, if not the case's; a
        file of poses over time, see `to_csv`; `progress` is for cases of fibres.
        """
        moved_by = "Rosenbrock" if self.implicit else "Tsit5"
        if solver is not None and solver.name != moved_by:
            fail("solver", f"be {moved_by}, by which bodies are moved", f"it is {solver.name}")
        if solver is not None and solver.tolerance is not None:
            tolerance = float(solver.tolerance)
        begun, compiling = time.perf_counter(), CompileClock()
        tolerance = self.tolerance if tolerance is None else tolerance
        start = self.assembly, self.pose, self.ts
        journey = travel(*start, tolerance=tolerance, implicit=self.implicit)
        if journey.code != Outcome.FINE:
            reached = int(np.isfinite(np.asarray(journey.poses.turn)).all(axis=(1, 2)).sum()) - 1
            last, sentence = float(journey.ts[reached]), Outcome(int(journey.code)).sentence
            message = f"The run of the bodies broke down after t = {last:g}: {sentence}"
            cause = Cause(int(journey.steps), last, None, "Assembly", message)
            raise SimulationError(cause, journey.solution(self.assembly))
        residual = jnp.zeros_like(journey.ts)
        if self.assembly.unknowns:
            residual = _residuals(self.assembly, journey)
        if file is not None:
            columns = {"place": journey.poses.place, "turn": journey.poses.turn}
            there = {name: value for name, value in columns.items() if value.size}
            to_csv(file, journey.ts, there)
        solution = dataclasses.replace(journey.solution(self.assembly), residual=residual)
        seconds = time.perf_counter() - begun, compiling.read()
        return dataclasses.replace(solution, wall_s=seconds[0], compile_s=seconds[1])


@eqx.filter_jit
def _residuals(assembly: Assembly, journey: Journey) -> Array:
    instants = journey.ts, journey.poses
    return jax.lax.map(lambda now: bodies_at(now[0], now[1], assembly).residual, instants)


@dataclass(frozen=True)
class ReadyMade:
    """A scene as the shell and the tests of all scenes see it.

    - `build`: function of the options that returns a `Case` (of rigid bodies an `AssemblyCase`); its
      defaults are the shell's.
    - `options`: name of each option and what it means.
    - `observables`: dimensionless results of a run, and `results`, what each of them means.
    - `plotted`: name of an observable over time, and the function of a solution that gives it.
    - `quick`: options with which it runs in seconds, as the shell takes them.
    - `stretch`: factor on the deflection in pictures.
    - `co_moving`: whether pictures follow the fibre's centre; by default if there is no flow.
    - `shown`: part of a run of which shapes are drawn, as `last_period`; all of it by default;
      `filmed`: the same of the movie.

    >>> from jaxbeads import scenes
    >>> ready = scenes.SETTLING
    >>> print(ready.name, list(ready.options), list(ready.results))
    settling ['beads', 'elasto_gravitational', 'model'] ['deflection', 'friction_ratio', 'tilt']
    >>> print(ready.build(beads=3).scene.chain.beads)
    3
    """

    name: str
    summary: str
    build: Callable[..., Any]
    options: dict[str, str]
    observables: Callable[[Any, Solution], dict[str, Value]]
    results: dict[str, str]
    plotted: tuple[str, Callable[[Any, Solution], Any]]
    _: KW_ONLY
    quick: str
    stretch: float = 1.0
    co_moving: bool | None = None
    shown: Callable[[Solution], Solution] = lambda solution: solution
    filmed: Callable[[Solution], Solution] = lambda solution: solution


SAMPLES = 40
"""Save times in a period of a driven fibre."""


def last_period(solution: Solution) -> Solution:
    """The last period of a driven fibre, its start included.

    >>> import jax, jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> states = jax.vmap(jb.State)(jnp.zeros((121, 3, 2)))  # forty in a period
    >>> run = jb.Solution(jnp.linspace(0.0, 3.0, 121), states, jnp.array(120), jnp.array(0))
    >>> print(jb.scenes.last_period(run).ts[jnp.array([0, -1])])
    [2. 3.]
    """
    last = slice(-SAMPLES - 1, None)
    times, states = jax.tree.map(lambda x: x[last], (solution.ts, solution.states))
    return Solution(times, states, solution.steps, solution.code)


def shape_changes(solution: Solution) -> float:
    """Largest distance of a bead from where it was one period earlier, once both shapes are laid over
    one another (moved and turned), over the last period [length].
    """
    position = np.asarray(solution.states.position)
    shape = position - position.mean(axis=1, keepdims=True)
    now, before = shape[-SAMPLES:], shape[-2 * SAMPLES : -SAMPLES]
    return float(np.abs(now @ best_rotation(now, before, np) - before).max())


def until_periodic(tolerance: float) -> Callable[[Solution], bool]:
    """Ends a driven run once its shape repeats from period to period to a tolerance [length]."""

    def periodic(solution: Solution) -> bool:
        return len(solution.ts) > 2 * SAMPLES and shape_changes(solution) < tolerance

    return periodic


def distance_swum(case: "Case", solution: Solution) -> np.ndarray:
    """Distance of the centre from its start over the first fibre's length."""
    centre = np.asarray(solution.states.position).mean(axis=1)
    return np.linalg.norm(centre - centre[0], axis=1) / float(case.scene.chain.length[0])


def worm_amplitude(chain: Chain, peak: float) -> Array:
    """Amplitude of the preferred curvature at the joints [1/length]: `peak` / L over the first half
    of the length, then falling linearly to zero at the tail.
    """
    fibre = chain.fibre_of_bead[1:-1]
    s = chain.arclength[1:-1] / chain.length[fibre]
    return peak / chain.length[fibre] * jnp.minimum(1.0, 2 * (1 - s))


@eqx.filter_jit
def _lateral_jacobian(scene: Scene, t: Array, held: int) -> Array:
    flat = straight(scene.chain, [1.0, 0.0]).position

    def lateral(y: Array) -> Array:
        return motion(t, State(flat.at[held:, 1].set(y)), scene).velocity[held:, 1]

    return jax.jacfwd(lateral)(jnp.zeros(scene.chain.beads - held))


def lateral_modes(scene: Scene, t: float = 0.0, held: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Growth rates of small deflections from a straight planar fibre along x, fastest growing first,
    and their shapes in columns.

    **Arguments**: `held`: number of beads at the first end that do not move.

    >>> from jaxbeads import scenes
    >>> scene = scenes.relaxation(beads=4).scene
    >>> rates, shapes = scenes.lateral_modes(scene)
    >>> print((rates.real < 1e-9).all(), shapes.shape)  # bends die away; shifts and turns stay
    True (4, 4)
    """
    jacobian = _lateral_jacobian(scene, jnp.asarray(t), held)
    values, shapes = np.linalg.eig(np.asarray(jacobian))
    order = np.argsort(-np.real(values))
    return values[order], shapes[:, order]


@eqx.filter_jit
def _jacobian(scene: Scene, state: State) -> Array:
    return linearise(0.0, coordinates(scene, state), scene).jacobian()


def modes(scene: Scene, state: State) -> np.ndarray:
    """Growth rates of small changes of a state in its coordinates [1/time], complex, fastest growing
    first, without those of what is held (which are zero).

    >>> import jaxbeads as jb
    >>> chain, spring = jb.Chain(radius=1.0, fibres=2), jb.force.Spring(6 * 3.14159265)
    >>> held = [jb.constraint.PrescribedPosition()]
    >>> scene = jb.Scene(chain, 1.0, jb.mobility.FreeDraining(), held, [spring])
    >>> print(jb.scenes.modes(scene, jb.straight(chain, [1.0, 0.0])).real.min().round(6))
    -1.0
    """
    jacobian = np.asarray(_jacobian(scene, state))
    size = np.abs(jacobian).max(axis=1)
    free = size > 1e-12 * size.max()
    values = np.linalg.eigvals(jacobian[np.ix_(free, free)]).astype(complex)
    return values[np.argsort(-np.real(values))]


def tip_radii(solution: Solution) -> np.ndarray:
    """Distance of the last bead from the x axis, at each time [length]."""
    return np.linalg.norm(np.asarray(solution.states.position)[:, -1, 1:], axis=1)


def whirl(solution: Solution, scene: Scene) -> tuple[float, float]:
    """Distance of the last bead from the x axis [length], and the rate at which it goes around it
    [1/time], at the end.

    >>> import jax, jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> around = jb.flow.LinearFlow([[0, 0, 0], [0, 0, -3], [0, 3, 0]])
    >>> scene = jb.Scene(jb.Chain(1.0, 1), 1.0, flow=around)
    >>> states = jax.vmap(jb.State)(jnp.array([[[0.0, 2.0, 0.0]]]))
    >>> run = jb.Solution(jnp.zeros(1), states, jnp.array(1), jnp.array(0))
    >>> print(jb.scenes.whirl(run, scene))
    (2.0, 3.0)
    """
    last = solution.final
    velocity = np.asarray(motion(solution.ts[-1], last, scene).velocity)[-1, 1:]
    place = np.asarray(last.position)[-1, 1:]
    square = float(place @ place)
    turning = float(place[0] * velocity[1] - place[1] * velocity[0])
    return square**0.5, turning / square if square else 0.0


def settled(length: float) -> Callable[[Solution], bool]:
    """Ends a run about the x axis once its small bend has died away to a hundredth, or once it has grown
    and the tip keeps its place along and off the axis.
    """

    def over(solution: Solution) -> bool:
        radii = tip_radii(solution) / length
        if len(radii) < 22:
            return False
        if radii[-1] < 0.01 * radii[0]:
            return True
        along = np.asarray(solution.states.position)[:, -1, 0] / length
        still = all(np.ptp(x[-21:]) < 1e-4 for x in (radii, along))
        return bool(still and along[-1] < 0.99 * along[0])

    return over
