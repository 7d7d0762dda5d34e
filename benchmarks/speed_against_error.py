"""Time against error: the linearly implicit solver beside explicit and general implicit ones.

    python benchmarks/speed_against_error.py [--quick] [--json] [--save] [--plot FILE]

Each scene is run over the same path with each solver, compiled beforehand; times are medians of three
runs or more in one process (of one, if it takes longer than 5 s). Settling fibres fall for t = 20 L/V_s
(V_s: speed of the rigid straight fibre), nematodes and beating filaments go three periods, sheared
fibres through their first tumble, a rod with curvature and twist winds up to its helix. Bacteria go as
far as a rigid one does in one turn of its tail, L being that of the helix.

- error: largest distance of a bead, at any of 41 times, from the reference, over L. The reference is
  `Rosenbrock` with tolerance 1e-9; `converged` is how far that with 1e-8 is from it, and AB3, where it
  runs the whole path, is an independent check of it.
- AB3 (39): the paper's step; AB3 limit: its largest stable multiple of it among 2.2, 2.1, ... Where that
  takes more than 40 000 steps (quick: 10 000), the time is measured over the first part of the path and
  scaled to the whole; such lines are marked * and have no error. Other solvers are given 40 000 steps.
- bacterium: moved by `travel`, whose explicit steps stand as Tsit5 and whose implicit ones as
  `Rosenbrock`; the error is that at the end. Beyond 1000 explicit steps, as for the flexible one, the
  time is scaled by the length of the next one.
- evaluations: of the velocity; a step of `Rosenbrock` has 6, and one linearisation, each.
- ratio: time of AB3 over that of `Rosenbrock` with the loosest tolerance whose error is at most 1e-4;
  step_cost: time of one of its steps over that of a step of AB3, which is one velocity evaluation;
  ratio_explicit, of bacteria: time of Tsit5 over that of `Rosenbrock`, chosen in the same way.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import numpy as np
from PIL import Image
from record import Program, duration, number, order, table

import jaxbeads as jb
from jaxbeads import Outcome, scenes
from jaxbeads.rollout import diagnostics
from jaxbeads.solver import AbstractSolver, Diffrax

jax.config.update("jax_enable_x64", True)

SAVES = 41
TARGET = 1e-4


class Path(NamedTuple):
    """A scene, its start and its last time."""

    case: scenes.Case | scenes.AssemblyCase
    end: float

    @property
    def length(self) -> float:
        chain = self.case.scene.chain
        if isinstance(self.case, scenes.AssemblyCase):
            return float(2 * chain.radii[1:].sum())  # that of the tail
        return float(chain.length[0])

    @property
    def times(self) -> np.ndarray:
        bodies = isinstance(self.case, scenes.AssemblyCase)
        return np.linspace(0.0, self.end, 2 if bodies else SAVES)


class Row(NamedTuple):
    solver: str
    steps: int
    evaluations: int | None
    wall_s: float
    compile_s: float
    error: float | None = None
    bond: float | None = None
    residual: float | None = None


def settling(beads: int, number: float, model: Any = scenes.GEARS) -> Path:
    case = scenes.settling(beads, number, model)
    speed = beads / float(scenes.settling_friction(case.scene))  # beads of weight 1
    return Path(case, 20 * float(case.scene.chain.length[0]) / speed)


def shear(beads: int, ratio: float) -> Path:
    case = scenes.shear(beads, ratio)
    return Path(case, float(case.ts[-1]))


def nematode(beads: int) -> Path:
    return Path(scenes.nematode(beads), 3.0)


def beating(beads: int) -> Path:
    return Path(scenes.planar_beating(beads), 3 * 2 * np.pi)


def helix(beads: int) -> Path:
    """A rod with curvature and twist winds up, from straight."""
    case = scenes.helix_formation(beads)
    return Path(case, float(case.ts[-1]))


def bacterium(flexible: float) -> Path:
    """A head and a helix that a motor spins, for one turn of a rigid one in space, from rest."""
    case = scenes.bacterium(flexible=flexible)
    return Path(case, float(case.ts[-1]) / 3)


QUICK: dict[str, Callable[[], Path]] = {
    "settling-34-1000": lambda: settling(34, 1e3),
    "settling-34-10": lambda: settling(34, 10.0),
    "nematode-15": lambda: nematode(15),
}
ALL = QUICK | {
    "settling-34-10000": lambda: settling(34, 1e4),
    "settling-20-1000": lambda: settling(20, 1e3),
    "settling-100-1000": lambda: settling(100, 1e3),
    "settling-31-1000-joint": lambda: settling(31, 1e3, scenes.JOINT),
    "shear-35-0.01": lambda: shear(35, 0.01),
    "shear-35-0.04": lambda: shear(35, 0.04),
    "beating-20": lambda: beating(20),
    "helix-34": lambda: helix(34),
    "bacterium": lambda: bacterium(0.0),
    "bacterium-flexible": lambda: bacterium(0.1),
}


def timed(function: Any, *arguments: Any, runs: int) -> tuple[float, Any]:
    """Median seconds of a call, and what it returns."""
    seconds, result = [], None
    while len(seconds) < runs:
        start = time.perf_counter()
        result = jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
        if seconds[-1] > 5:
            break
    return statistics.median(seconds), result


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - start


def distance(path: Path, states: jb.State, reference: jb.State) -> float:
    apart = np.asarray(states.position) - np.asarray(reference.position)
    return float(np.linalg.norm(apart, axis=-1).max()) / path.length


def checked(path: Path, row: Row, run: jb.Solution, reference: jb.State) -> Row:
    """With its errors; bodies have neither bonds nor constraints that could fail."""
    error = distance(path, run.states, reference)
    if isinstance(path.case, scenes.AssemblyCase):
        return row._replace(error=error)
    residual, bond = jax.jit(diagnostics)(path.case.scene, run.ts, run.states)
    return row._replace(error=error, bond=float(bond.max()), residual=float(residual.max()))


def adaptive(
    path: Path, solver: AbstractSolver, tolerances: tuple[float, ...]
) -> list[tuple[Row, jb.Solution | None]]:
    """Runs of a solver with several tolerances, one compiled program for all."""
    case = path.case
    bodies = isinstance(case, scenes.AssemblyCase)

    def run(scene: Any, start: Any, ts: Any, tolerance: Any) -> Any:
        if bodies:
            implicit = solver.name == "Rosenbrock"
            most = 100_000 if implicit else 1000
            options = {"tolerance": tolerance, "implicit": implicit, "max_steps": most}
            return jb.travel(scene, start, ts, **options)
        by = dataclasses.replace(solver, tolerance=tolerance, max_steps=1000)
        return jb.rollout(scene, start, ts, solver=by)

    begun = (case.assembly, case.pose) if bodies else (case.scene, case.state)
    first = (*begun, path.times)
    program, compiling = compiled(run, *first, tolerances[0])
    per_step = {"Rosenbrock": 6, "Tsit5": 6 + bodies}.get(solver.name)
    rows = []
    for tolerance in tolerances:
        wall, solution = timed(program, *first, tolerance, runs=5 if per_step else 3)
        steps = int(solution.steps)
        name = f"{solver.name} {tolerance:.0e}"
        count = None if per_step is None else per_step * steps
        row = Row(name, steps, count, wall, compiling)
        if int(solution.code) == 0:
            rows.append((row, solution.solution(case.assembly) if bodies else solution))
            if wall < (60 if bodies else 30):
                continue
        elif bodies and int(solution.code) == Outcome.TOO_MANY_STEPS:
            whole = round(path.end / float(solution.step))
            wall *= whole / steps
            rows.append((Row(name + " *", whole, 7 * whole, wall, compiling), None))
        else:
            rows.append((row._replace(solver=name + " failed"), None))
        break
    return rows


def ab3(path: Path, multiple: float, most: int) -> tuple[Row, jb.Solution | None]:
    """AB3 with a multiple of the step (39); `None` if it has not gone the whole path."""
    case = path.case
    step = multiple * float(jb.solver.explicit_step(case.scene))
    substeps = int(np.ceil(path.end / (SAVES - 1) / step * (1 - 1e-9)))
    steps = substeps * (SAVES - 1)
    whole = steps <= most
    ts = path.times if whole else np.linspace(0.0, path.end * most / steps, 3)
    count = substeps if whole else most // 2

    def run(scene: jb.Scene, state: jb.State, ts: Any) -> jb.Solution:
        return jb.rollout(scene, state, ts, solver=jb.AB3(substeps=count))

    program, compiling = compiled(run, case.scene, case.state, ts)
    wall, solution = timed(program, case.scene, case.state, ts, runs=3)
    if int(solution.code) != 0:
        wall = np.nan
    wall *= steps / int(solution.steps)
    row = Row(f"AB3 {multiple:.2g} x (39)", steps, steps, wall, compiling)
    if not whole:
        return row._replace(solver=row.solver + " *"), None
    return row, solution


def ab3_at_its_limit(path: Path, most: int) -> tuple[Row, jb.Solution | None]:
    for multiple in (2.2, 2.1, 2.0, 1.8, 1.5, 1.2):
        row, solution = ab3(path, multiple, most)
        if np.isfinite(row.wall_s):
            return row, solution
    return ab3(path, 1.0, most)


def measure(path: Path, quick: bool) -> tuple[list[Row], dict[str, float]]:
    """All rows of a scene and its figures."""
    most = 10_000 if quick else 40_000
    tolerances = (
        (1e-3, 1e-4, 3e-5, 1e-5, 1e-6) if quick else (1e-2, 1e-3, 1e-4, 3e-5, 1e-5, 1e-6, 1e-7)
    )
    own = adaptive(path, jb.solver.Rosenbrock(), (*tolerances, 1e-8, 1e-9))
    last = own[-1][1]
    if last is None:
        raise RuntimeError(f"the reference stopped: {own[-1][0]}")
    reference = last.states

    def with_errors(runs: list[tuple[Row, jb.Solution | None]]) -> list[Row]:
        return [row if run is None else checked(path, row, run, reference) for row, run in runs]

    rows = with_errors(own[:-1])
    best = loosest(rows)
    figures = {"error": best.error, "wall_s": best.wall_s, "converged": rows[-1].error}
    if isinstance(path.case, scenes.AssemblyCase):
        explicit = with_errors(adaptive(path, Diffrax(diffrax.Tsit5()), tolerances))
        rows += explicit
        figures |= {"ratio_explicit": loosest(explicit).wall_s / best.wall_s}
    else:
        paper, limit = ab3(path, 1.0, most), ab3_at_its_limit(path, most)
        others = [paper, limit]
        if not quick:
            others += adaptive(path, Diffrax(diffrax.Tsit5()), (1e-4, 1e-6))
            others += adaptive(path, Diffrax(diffrax.Kvaerno5()), (1e-4, 1e-6))
        rows += with_errors(others)
        figures |= {
            "ratio": paper[0].wall_s / best.wall_s,
            "ratio_limit": limit[0].wall_s / best.wall_s,
            "step_cost": best.wall_s / best.steps * paper[0].steps / paper[0].wall_s,
        }
    return rows, {name: float(value) for name, value in figures.items() if value is not None}


def loosest(rows: list[Row]) -> Row:
    """The first whose error is small enough, or that was timed over a part."""
    return next(r for r in rows if r.solver.endswith("*") or (r.error or 0.0) <= TARGET)


def text(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def draw(results: dict[str, list[Row]], file: str) -> None:
    """Work-precision plot: one panel for each scene."""
    import matplotlib.pyplot as plt

    across = min(len(results), 5)
    down = -(-len(results) // across)
    figure, axes = plt.subplots(
        down, across, figsize=(3.2 * across, 2.9 * down), squeeze=False, layout="constrained"
    )
    for panel in axes.flat[len(results) :]:
        panel.set_axis_off()
    for panel, (name, rows) in zip(axes.flat, results.items(), strict=False):
        for family, marker in (("Rosenbrock", "oC0-"), ("Tsit5", "sC1-"), ("Kvaerno5", "^C2-")):
            mine = [r for r in rows if r.solver.startswith(family) and r.error]
            if mine:
                panel.loglog(
                    [r.error for r in mine], [r.wall_s for r in mine], marker, label=family
                )
        for row in rows:
            if row.solver.startswith("AB3") and np.isfinite(row.wall_s):
                color = "0.2" if row.solver.startswith("AB3 1 x") else "0.6"
                panel.axhline(row.wall_s, color=color, ls="--", label=row.solver.rstrip(" *"))
        panel.set_title(name, fontsize=9)
        panel.set_xlabel("error over $L$")
    axes[0, 0].set_ylabel("wall time [s]")
    axes[0, 0].legend(fontsize=6)
    figure.savefig(file, dpi=110)
    if file.endswith(".png"):
        with Image.open(file) as whole:  # a few colours: a quarter of the size
            few = whole.convert("RGB").quantize(64, Image.Quantize.FASTOCTREE, dither=0)
        few.save(file, optimize=True)


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    head = (
        "scene",
        "AB3 at (39)",
        "at its limit",
        "Tsit5",
        "Kvaerno5",
        "Rosenbrock, its error",
        "steps",
        "AB3/Rosenbrock, and at the limit",
    )
    none: dict[str, Any] = {"wall_s": None, "steps": None, "solver": ""}
    lines = []
    for name, rows in figures["rows"].items():
        found = figures["figures"][name]
        paper, limit = [r for r in rows if r["solver"].startswith("AB3")] or (none, none)

        def best(solver: str, rows: list[dict[str, Any]] = rows) -> dict[str, Any]:
            good = (r for r in rows if r["solver"].startswith(solver) and r["error"] is not None)
            part = (r for r in rows if r["solver"].startswith(solver) and r["solver"][-1] == "*")
            return next((r for r in good if r["error"] <= TARGET), next(part, none))

        own = best("Rosenbrock")
        lines.append(
            [
                name,
                *(
                    duration(r["wall_s"]) + r"\*" * r["solver"].endswith("*")
                    for r in (paper, limit, best("Tsit5"), best("Kvaerno5"))
                ),
                f"{duration(own['wall_s'])}, {order(found['error'])}",
                str(own["steps"]),
                ", ".join(number(found[x]) for x in ("ratio", "ratio_limit") if x in found) or "-",
            ]
        )
    return {"speed-against-error": table(head, lines)}


def values(figures: dict[str, Any]) -> dict[str, str]:
    """What the pages say: but for the soft fibre, how much faster; what a step costs."""
    found = figures["figures"]
    fibres = {name: row for name, row in found.items() if "ratio" in row}
    ratios = [row["ratio"] for name, row in fibres.items() if name != "settling-34-10000"]
    costs = [row["step_cost"] for row in fibres.values()]
    return {
        "speed-up": f"{number(min(ratios))} to {number(max(ratios))}",
        "step-cost": f"{number(min(costs))} to {number(max(costs))}",
    }


def main() -> None:
    program = Program(__doc__, "three scenes, in under 3 minutes")
    program.parser.add_argument("--plot", metavar="FILE", help="write a work-precision plot")
    program.parser.add_argument("--only", metavar="SCENE", help="one scene")
    arguments = program.arguments()
    chosen = QUICK if arguments.quick else ALL
    if arguments.only:
        chosen = {arguments.only: ALL[arguments.only]}
    figures, results = {}, {}
    for name, build in chosen.items():
        rows, figures[name] = measure(build(), arguments.quick)
        results[name] = rows
        found = figures[name]
        print(f"\n{name}: reference converged to {found['converged']:.1e} L")
        head = (
            "solver",
            "steps",
            "evaluations",
            "wall [s]",
            "compile",
            "error/L",
            "bonds",
            "residual",
        )
        print(("{:<20}{:>10}{:>12}{:>11}" + "{:>9}" * 4).format(*head))
        for row in rows:
            parts = (
                f"{row.solver:<20}{row.steps:>10}{text(row.evaluations, 'd'):>12}{row.wall_s:>11.4g}"
                f"{row.compile_s:>9.1f}{text(row.error, '.1e'):>9}{text(row.bond, '.1e'):>9}"
                f"{text(row.residual, '.1e'):>9}"
            )
            print(parts)
        if "ratio" in found:
            over = (
                f"AB3 over that of Rosenbrock with error {found['error']:.1e}: {found['ratio']:.4g} at "
                f"(39), {found['ratio_limit']:.4g} at its limit; a step costs {found['step_cost']:.3g} "
                "evaluations"
            )
        else:
            over = f"Tsit5 over that of Rosenbrock: {found['ratio_explicit']:.4g}"
        print(f"time of {over}", flush=True)
    if arguments.plot:
        draw(results, arguments.plot)
    kept = {name: [row._asdict() for row in rows] for name, rows in results.items()}
    program.end({"figures": figures, "rows": kept}, figures)


if __name__ == "__main__":
    main()
