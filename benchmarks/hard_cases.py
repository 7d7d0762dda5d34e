"""Numerical stability: cases that break solvers, each with its end and its error, or why it stopped.

    python benchmarks/hard_cases.py [--quick] [--json] [--save] [--only TEXT]

Each case is run with `simulate`, by default with the solver and the tolerance (1e-6) that the scene gets
by itself. A run that reaches its end is compared with a reference: that with a tolerance of 1e-9, or
what the line says. Where neighbouring paths part, no solver can do better than what a displacement of
the start does: `start` is how far the reference moves if every bond is first turned by random angles of
the size of the tolerance. A result counts as right if its error is at most
the number of steps times the tolerance of a step (0.01 L where steps are equal and have no tolerance),
or 20 times that displacement.

- error, start: largest distance of a bead from the reference at any saved time, over L.
- bonds: largest relative error of a bond length.

The last line counts silent wrong results; the exit code is 1 if there is one.
"""

import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from record import Program, order, table
from speed_against_error import distance, settling

import jaxbeads as jb
from jaxbeads import scenes
from jaxbeads.constraint import Gears, clamped
from jaxbeads.coordinates import coordinates
from jaxbeads.flow import Extension, Shear
from jaxbeads.force import Bending, Contact
from jaxbeads.solver import AbstractSolver, Diffrax

jax.config.update("jax_enable_x64", True)


class Run(NamedTuple):
    """A scene, its start, the times to save at, and how it is run."""

    scene: jb.Scene
    state: jb.State
    ts: np.ndarray
    options: Mapping[str, Any] = MappingProxyType({})
    reference: Callable[["Run"], jb.State] | None = None
    """States that stand for the exact ones; by default those with a tolerance of 1e-9."""
    note: Callable[["Run", jb.Solution], str] | None = None
    """What else is to be seen."""

    @property
    def tolerance(self) -> float:
        return self.options.get("tolerance", 1e-6)


def steps(end: float, count: int = 40) -> np.ndarray:
    return np.linspace(0.0, end, count + 1)


def falling(beads: int, number: float, **options: Any) -> Run:
    path = settling(beads, number)
    return Run(path.case.scene, path.case.state, path.times, options)


def softest(contact: bool) -> Run:
    """B = 10^5: the fibre folds up."""
    run = falling(34, 1e5)
    if not contact:
        return run
    scene = run.scene
    scene = eqx.tree_at(lambda s: s.forces, scene, (*scene.forces, Contact(20.0, 0.1, 0.1)))
    return run._replace(scene=scene, note=smallest_gap)


def symmetric(perturbation: float) -> Run:
    """B = 10^4 from (all but) straight, until after the W has given way."""
    case = scenes.settling(34, 1e4, perturbation=perturbation)
    speed = 34 / float(scenes.settling_friction(case.scene))
    ts = np.linspace(0, 70 * 68 / speed, 281)
    return Run(case.scene, case.state, ts, note=w_shape)


def w_shape(run: Run, solution: jb.Solution) -> str:
    """When there are two troughs, and when the shape is lopsided by 1 % of L."""
    height = np.asarray(solution.states.position)[:, :, 1]
    slope = np.diff(height, axis=1)
    troughs = np.sum((slope[:, :-1] < 0) & (slope[:, 1:] > 0), axis=1)
    length = float(run.scene.chain.length[0])
    lopsided = np.ptp(height - height[:, ::-1], axis=1) / length
    speed = 34 / float(scenes.settling_friction(run.scene))
    time = np.asarray(solution.ts) * speed / length
    seen, gone = time[troughs == 2], time[lopsided > 0.01]
    when = f"W from {seen[0]:.0f}" if len(seen) else "no W"
    way = f"gives way at {gone[0]:.0f} L/V_s" if len(gone) else "does not give way"
    return f"{when}, {way}; asymmetry at t = 0: {lopsided[0]:.0e} L"


def flexible_shear() -> Run:
    case = scenes.shear(35, 0.001)
    return Run(case.scene, case.state, np.linspace(0, case.ts[-1], 101), note=smallest_gap)


def smallest_gap(run: Run, solution: jb.Solution) -> str:
    """How close beads come that are no neighbours."""
    x, chain = np.asarray(solution.states.position), run.scene.chain
    apart = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    i, fibre = np.arange(chain.beads), chain.fibre_of_bead
    near = (abs(i[:, None] - i[None]) <= 1) & (fibre[:, None] == fibre[None])
    return f"smallest gap {apart[:, ~near].min() - 2 * float(chain.radius):.2f} a"


def stiff() -> Run:
    """A rod in shear with K_b = 10^6 mu rate L^4, against one whose joints are frozen."""
    case = scenes.jeffery(10)
    length = float(case.scene.chain.length[0])
    bending = Bending(1e6 * length**4)
    scene = jb.Scene(
        case.scene.chain, 1.0, constraints=[Gears()], forces=[bending], flow=Shear(1.0)
    )
    return Run(scene, case.state, steps(2 * 52.942), reference=frozen)


def frozen(run: Run) -> jb.State:
    case = scenes.jeffery(10)
    return jb.simulate(case.scene, run.state, run.ts, tolerance=1e-10, progress=False).states


def kinked(angle: float) -> Run:
    """20 beads bent at one joint, which straighten."""
    chain = jb.Chain(1.0, 20)
    turn = np.where(np.arange(19) < 9, 0.0, np.deg2rad(angle))
    state = jb.State(jb.from_tangents(chain, np.stack([np.cos(turn), np.sin(turn)], axis=1)))
    return Run(
        jb.Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(100.0)]), state, steps(1e4)
    )


def hairpin() -> Run:
    """20 beads in two parallel rows joined by a half turn of six, which open."""
    chain = jb.Chain(1.0, 20)
    turn = np.clip((np.arange(19) - 6.5) / 5, 0, 1) * np.pi
    state = jb.State(jb.from_tangents(chain, np.stack([np.cos(turn), np.sin(turn)], axis=1)))
    return Run(
        jb.Scene(chain, 1.0, constraints=[Gears()], forces=[Bending(100.0)]), state, steps(1e4)
    )


def squeezed() -> Run:
    """Two fibres that a straining flow presses together."""
    chain = jb.Chain(1.0, (10, 10))
    forces = [Bending(50.0), Contact(200.0, 0.2, 0.1)]
    scene = jb.Scene(chain, 1.0, constraints=[Gears()], forces=forces, flow=Extension(0.5))
    state = jb.straight(chain, [1.0, 0.0], [[-1.0, -6.0], [1.0, 6.0]])
    return Run(scene, state, steps(12.0), note=smallest_gap)


def dropped() -> Run:
    """A fibre that falls across another one, which is lighter."""
    chain = jb.Chain(1.0, (9, 12))
    weight = jnp.where(jnp.asarray(chain.fibre_of_bead)[:, None] == 0, 1.0, 0.2)
    forces = [
        Bending(50.0),
        Contact(20.0, 0.2, 0.1),
        jb.force.ForceField(lambda t, x: -weight * jnp.array([[0.0, 1.0]])),
    ]
    scene = jb.Scene(chain, 1.0, constraints=[Gears()], forces=forces)
    state = jb.straight(chain, [1.0, 0.0], [[2.0, 8.0], [0.0, 0.0]])
    return Run(scene, state, steps(400.0), note=smallest_gap)


def orbits() -> Run:
    """A stiff rod of 5 beads over 100 Jeffery orbits; the note has the phase that it is off."""
    case = scenes.jeffery(5)
    scene = jb.Scene(
        case.scene.chain, 1.0, constraints=[Gears()], forces=[Bending(1e5)], flow=Shear(1.0)
    )
    return Run(scene, case.state, np.linspace(0, 100 * 31.876, 2001), note=turns)


def turns(run: Run, solution: jb.Solution) -> str:
    angle = np.unwrap(np.asarray(jb.observables.orientation(solution.states.position)))
    return f"{abs(angle[-1] - angle[0]) / (2 * np.pi):.4f} turns"


def beating(number: float) -> Run:
    case = scenes.planar_beating(20, number)
    return Run(case.scene, case.state, steps(3 * 2 * np.pi, 120))


def nematode(factor: float) -> Run:
    case = scenes.nematode(15)
    bending = case.scene.forces[0]
    scene = eqx.tree_at(
        lambda s: s.forces[0].intrinsic_curvature.amplitude,
        case.scene,
        factor * bending.intrinsic_curvature.amplitude,
    )
    reference = at_rest if factor == 0 else None
    return Run(scene, case.state, steps(3.0, 120), reference=reference, note=smallest_gap)


def at_rest(run: Run) -> jb.State:
    return jax.vmap(lambda _: run.state)(jnp.asarray(run.ts))


def single(beads: int, tolerance: float) -> Run:
    """In float32, against float64."""
    run = falling(beads, 1e3, tolerance=tolerance, single_precision=True)
    scene, state = jax.tree.map(lambda x: x.astype(jnp.float32), (run.scene, run.state))
    return run._replace(scene=scene, state=state, reference=double)


def double(run: Run) -> jb.State:
    path = settling(run.scene.chain.beads, 1e3)
    exact = jb.simulate(path.case.scene, path.case.state, run.ts, tolerance=1e-9, progress=False)
    return exact.states


def long_steps(solver: AbstractSolver, multiple: float) -> Run:
    """Settling, N = 34, B = 1000, with a multiple of the paper's step (39)."""
    run = falling(34, 1e3)
    step = multiple * float(jb.solver.explicit_step(run.scene))
    count = int(np.ceil(run.ts[1] / step))
    return run._replace(options={"solver": dataclasses.replace(solver, substeps=count)})


FLOOR = jb.NoSlipWall([0.0, 0.0], [0.0, 1.0])


def clearance(run: Run, solution: jb.Solution) -> str:
    """How close surfaces come to the wall, but for that of a first bead that may be held there."""
    chain = run.scene.chain
    gap = jax.vmap(lambda x: run.scene.domain.clearance(x, chain.radius))(solution.states.position)
    last = f"the last bead's at the end {float(gap[-1, -1]):.3f} a"
    return f"smallest gap to the wall {float(jnp.min(gap[:, 1:])):.3f} a, {last}"


def on_wall(weight: float, height: float, slope: float = 0.0, contact: bool = True) -> Run:
    """A fibre above the wall, level or sloping, lowest bead at a height, under a weight."""
    chain = jb.Chain(1.0, 15)
    forces = [Bending(100.0), jb.force.Weight([0.0, weight])]
    if contact:
        forces.append(Contact(20.0, 0.1, 0.1))
    scene = jb.Scene(chain, 1.0, constraints=[Gears()], forces=forces, domain=FLOOR)
    state = jb.straight(chain, [np.cos(slope), np.sin(slope)])
    rise = height - jnp.min(state.position[:, 1])
    state = jb.State(state.position + rise * jnp.array([[0.0, 1.0]]))
    return Run(scene, state, steps(400.0), note=clearance)


def lying(rate: float, weight: float) -> Run:
    """A cilium, clamped upright on the wall, that shear or its weight bends down to it."""
    chain = jb.Chain(1.0, 15)
    forces = [Bending(300.0), Contact(100.0, 0.1, 0.1)]
    if weight:
        forces.append(jb.force.Weight([0.2 * weight, -weight]))
    scene = jb.Scene(
        chain,
        1.0,
        constraints=[Gears(), *clamped()],
        forces=forces,
        flow=Shear(rate) if rate else None,
        domain=FLOOR,
    )
    state = jb.straight(chain, [0.0, 1.0], [[0.0, 15.2]])
    return Run(scene, state, steps(10.0 if rate else 1000.0), note=clearance)


CASES: dict[str, Callable[[], Run]] = {
    "shear, bending ratio 0.001": flexible_shear,
    "settling, B = 10^5": lambda: softest(False),
    "settling, B = 10^5, with contact": lambda: softest(True),
    "settling, B = 10^-6": lambda: falling(34, 1e-6),
    "shear, K = 10^6 mu rate L^4, against rigid": stiff,
    "kinked by 90 degrees": lambda: kinked(90.0),
    "kinked by 170 degrees: beads overlap": lambda: kinked(170.0),
    "folded flat onto itself": lambda: kinked(180.0),
    "hairpin": hairpin,
    "two fibres pressed together": squeezed,
    "one fibre dropped on another": dropped,
    "settling, odd N = 35": lambda: falling(35, 1e3),
    "settling, N = 200": lambda: falling(200, 1e3),
    "100 Jeffery orbits": orbits,
    "planar beating, Sp = 0.1": lambda: beating(0.1),
    "planar beating, Sp = 20": lambda: beating(20.0),
    "nematode, no actuation": lambda: nematode(0.0),
    "nematode, 20 times the curvature": lambda: nematode(20.0),
    "float32, N = 10": lambda: single(10, 1e-4),
    "float32, N = 34": lambda: single(34, 1e-4),
    "float32, tolerance 1e-6": lambda: single(10, 1e-6),
    "AB3, 100 times the step (39)": lambda: long_steps(jb.AB3(), 100.0),
    "Tsit5, 100 times the step (39)": lambda: long_steps(Diffrax(diffrax.Tsit5()), 100.0),
    "Rosenbrock, 100 times the step (39)": lambda: long_steps(jb.Rosenbrock(), 100.0),
    "Rosenbrock, 1800 times the step (39)": lambda: long_steps(jb.Rosenbrock(), 1842.0),
    "tolerance 1e-2": lambda: falling(34, 1e3, tolerance=1e-2),
    "tolerance 1e-10": lambda: falling(34, 1e3, tolerance=1e-10),
    "B = 10^4, sloping by 1e-6 rad at one end": lambda: symmetric(1e-6),
    "B = 10^4, exactly straight": lambda: symmetric(0.0),
    "wall: a fibre pressed onto it": lambda: on_wall(-1.0, 3.0, 0.2),
    "wall: a fibre pressed onto it, no contact": lambda: on_wall(-1.0, 3.0, 0.2, contact=False),
    "wall: a start that touches it, pulled off": lambda: on_wall(1.0, 1.0),
    "wall: a start that touches it, pressed on": lambda: on_wall(-1.0, 1.0),
    "wall: a cilium laid down by shear": lambda: lying(10.0, 0.0),
    "wall: a cilium laid down by its weight": lambda: lying(0.0, 2.0),
}

QUICK = (
    "settling, B = 10^-6",
    "kinked by 90 degrees",
    "folded flat onto itself",
    "AB3, 100 times the step (39)",
    "Rosenbrock, 100 times the step (39)",
    "tolerance 1e-2",
    "nematode, no actuation",
)


class Outcome(NamedTuple):
    reached: bool
    right: bool
    error: float | None
    start: float | None
    bond: float | None
    steps: int
    wall_s: float
    message: str


def displaced(run: Run) -> jb.State:
    """The start with its bonds turned by angles of the size of the tolerance."""
    chart = coordinates(run.scene, run.state)
    x = np.random.default_rng(0).normal(size=chart.origin.shape) * run.tolerance
    return chart.state(jnp.asarray(x, chart.origin.dtype).at[: chart.sizes[0]].set(0.0))


def exact(run: Run, state: jb.State) -> jb.State:
    tolerance = min(1e-9, run.tolerance / 10)
    options = {"tolerance": tolerance, "overlap": True, "progress": False}
    return jb.simulate(run.scene, state, run.ts, **options).states


def outcome(run: Run) -> Outcome:
    started = time.perf_counter()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            solution = jb.simulate(run.scene, run.state, run.ts, progress=False, **run.options)
    except (ValueError, jb.SimulationError) as stop:
        end = time.perf_counter() - started
        at = getattr(stop, "solution", None)
        return Outcome(
            False, True, None, None, None, 0 if at is None else int(at.steps), end, str(stop)
        )
    wall = float(solution.wall_s - solution.compile_s)
    path: Any = Path(run)
    reference = (run.reference or (lambda run: exact(run, run.state)))(run)
    error = distance(path, solution.states, reference)
    start = None
    if run.reference is None:
        start = distance(path, exact(run, displaced(run)), reference)
    steps = int(solution.steps)
    allowed = 0.01 if "solver" in run.options else steps * run.tolerance
    right = error <= max(allowed, 20 * (start or 0.0))
    notes = [str(w.message) for w in caught]
    if run.note is not None:
        notes.insert(0, run.note(run, solution))
    bond = float(np.max(solution.bond_length_error))
    return Outcome(True, right, error, start, bond, steps, wall, " ".join(notes))


class Path(NamedTuple):
    """What `distance` asks for."""

    run: Run

    @property
    def length(self) -> float:
        return float(jnp.max(self.run.scene.chain.length))


def text(value: float | None) -> str:
    return "-" if value is None else f"{value:.1e}"


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    """What reached its end, and what was stopped; a wrong result would be called so."""
    ended, stopped = [], []
    for name, row in figures.items():
        steps, said = str(row["steps"]), row["message"].replace("|", r"\|")
        if row["reached"]:
            errors = (order(row[c]) for c in ("error", "start", "bond"))
            ended.append([name + " **wrong**" * (not row["right"]), *errors, steps, said])
        else:
            stopped.append([name, steps, said])
    return {
        "hard-cases": table(("case", "error", "start", "bonds", "steps", "seen"), ended),
        "hard-cases-stopped": table(("case", "steps", "stopped with"), stopped),
    }


def main() -> None:
    program = Program(__doc__, "a few of them")
    program.parser.add_argument("--only", metavar="TEXT", help="those whose names hold this")
    arguments = program.arguments()
    names = QUICK if arguments.quick else tuple(CASES)
    names = tuple(name for name in names if arguments.only is None or arguments.only in name)
    found = {}
    print(f"{'case':<44}{'error':>9}{'start':>9}{'bonds':>9}{'steps':>8}{'run [s]':>9}")
    for name in names:
        o = found[name] = outcome(CASES[name]())
        numbers = (
            f"{text(o.error):>9}{text(o.start):>9}{text(o.bond):>9}{o.steps:>8}{o.wall_s:>9.3f}"
        )
        print(f"{name:<44}{numbers}{'' if o.right else '  WRONG'}")
        if o.message:
            print(f"    {'' if o.reached else 'stopped: '}{o.message}", flush=True)
    wrong = [name for name, o in found.items() if not o.right]
    print(
        f"{len(found)} cases, {sum(not o.reached for o in found.values())} stopped with a message, "
    )
    print(f"{len(wrong)} silent wrong results{': ' + '; '.join(wrong) if wrong else ''}")
    program.end({name: o._asdict() for name, o in found.items()})
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
