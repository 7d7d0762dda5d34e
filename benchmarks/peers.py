"""Mobility of pygrpy and settling fibre of SoftMobility beside those of jaxbeads, in one run.

    python benchmarks/peers.py [--quick] [--json] [--save] [--environments FOLDER]

Mobility: forces and torques on N beads in space give velocities and spins, by Rotne-Prager-Yamakawa
with rotation. pygrpy builds the 6N x 6N matrix and multiplies it, by NumPy and in one `jit`; jaxbeads
takes `rpy(...).motion(load)` (fields) or `rpy_motion` (pair by pair), each in one `jit`. Medians of
equally many calls. The difference is the largest of any two of the four, over the largest velocity or
spin. Compiling, with tracing, is apart.

Fibre: that of SoftMobility's example `02_sinking_fiber` (a notebook of its repository, not of the wheel:
N = 10, K_b = 0.02 F L^2 with L = 18 a, nearly upright at first, default scheme, steps of 0.5), followed
to t = 2000, planar as there and in space; beside the same beads, weight and K_b in jaxbeads, by AB3 with
that step and by the default. The path is timed 8 times or, in SoftMobility, in 8 parts. `speed` is that
of the last part, `slope_deg` how far the line from end to end is below the horizontal, `span/L` its
length, `difference/a` the largest distance of a bead at t = 2000 from jaxbeads with a tolerance of
1e-10: time stepping for jaxbeads, the model for SoftMobility. The models' differences are printed too.

Each package gets an environment of its own in FOLDER, with the jax of this one, which is kept for the
next run; jaxbeads runs in this interpreter. Both in float64, with LAPACK on one thread: matrices are
small, and on busy cores its threads wait for one another. `--quick` leaves SoftMobility out, because it
compiles for minutes.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy, also for the peers

import jax
import jax.numpy as jnp
import numpy as np
from peers_worker import compiled, median_seconds
from record import Program, duration, number, order, table

import jaxbeads as jb
from jaxbeads.constraint import Gears
from jaxbeads.force import Bending, Weight

jax.config.update("jax_enable_x64", True)
PEERS = {"pygrpy": "pygrpy==0.1.5", "softmobility": "SoftMobility==1.2.0"}
WORKER = Path(__file__).with_name("peers_worker.py")

BEADS, RADIUS, WEIGHT, ANGLE = 10, 1.0, 1.0, 31 * np.pi / 64
LENGTH = 2 * RADIUS * (BEADS - 1)  # between the outer centres, as in the example
RIGIDITY = 0.02 * BEADS * WEIGHT * LENGTH**2
STEP, STEPS, CALLS = 0.5, 500, 8  # 8 parts of 500 steps
MODELS = """
Where the two fibres differ (SoftMobility 1.2.0 as installed; jaxbeads as set up here):
- bending: torques K_b/(2a) (q[i-1] - 2 q[i] + q[i+1]), linear in the rotation vectors q of the beads, as
  between neighbouring beads; jaxbeads: K_b |e x e'|/(2a) between neighbouring bonds.
- constraints: none to solve; the unknowns are the first bead's place and turn and the other beads'
  angles, a bond points along the mean of its two beads. jaxbeads: unknown positions, no slip at contacts
  (Gears) by multipliers.
- hydrodynamics: the same RPY with rotation; SoftMobility inverts the 6N x 6N matrix, and J^T R J.
  jaxbeads factorises J M J^T.
- time: classical Runge-Kutta, four evaluations a step of 0.5. AB3: one, at the same step. The default of
  jaxbeads (Rosenbrock): steps by a tolerance of 1e-6.
- with planar=True bonds turn against their beads (positions use +sin, spins -sin): contacts slip.
"""


def environment(folder: Path, peer: str) -> Path:
    """The interpreter of an environment that holds the peer, made where it is missing."""
    wanted = f"{PEERS[peer]} jax=={jax.__version__} numpy=={np.__version__}"
    place, windows = folder / peer, os.name == "nt"
    python = place / ("Scripts/python.exe" if windows else "bin/python")
    made = place / "made.txt"
    if made.exists() and made.read_text() == wanted and python.exists():
        return python
    print(f"installing {wanted} into {place}", file=sys.stderr, flush=True)
    made.unlink(missing_ok=True)
    for command in (
        [sys.executable, "-m", "venv", str(place)],
        [str(python), "-m", "pip", "install", "--quiet", *wanted.split()],
    ):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    made.write_text(wanted)
    return python


def ask(python: Path, peer: str, request: dict[str, Any]) -> dict[str, Any]:
    """What the peer answers."""
    done = subprocess.run(
        [str(python), str(WORKER), peer], input=json.dumps(request), capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(f"{peer} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def mobility(python: Path, beads: int, calls: int) -> dict[str, float]:
    """Times, largest difference and ratios for a cloud of beads, some of which overlap."""
    rng = np.random.default_rng(beads)
    position = rng.uniform(0, 4 * beads ** (1 / 3), size=(beads, 3))
    force, torque = rng.normal(size=(2, beads, 3))
    theirs = ask(
        python,
        "pygrpy",
        {
            "position": position.tolist(),
            "radius": RADIUS,
            "load": [*force.ravel().tolist(), *torque.ravel().tolist()],
            "calls": calls,
        },
    )
    arguments = (
        jnp.asarray(position),
        jnp.asarray(RADIUS),
        jnp.asarray(1.0),
        jnp.asarray(force),
        jnp.asarray(torque),
    )

    def fields(position: Any, radius: Any, viscosity: Any, force: Any, torque: Any) -> Any:
        operator = jb.tensors.rpy(jb.Configuration(position, radius, viscosity))
        motion = operator.motion(jb.Load(force, torque))
        return motion.velocity, motion.spin

    def pairs(position: Any, radius: Any, viscosity: Any, force: Any, torque: Any) -> Any:
        load = jb.Load(force, torque)
        motion = jb.tensors.rpy_motion(jb.Configuration(position, radius, viscosity), load)
        return motion.velocity, motion.spin

    seconds, compiling, motions = [], [], [np.array(x) for x in theirs["motions"]]
    for function in (fields, pairs):
        program, compile_s = compiled(function, *arguments)
        seconds.append(median_seconds(lambda program=program: program(*arguments), calls))
        compiling.append(compile_s)
        motions.append(np.concatenate([np.ravel(x) for x in program(*arguments)]))
    parts = np.stack(motions).reshape(4, 2, 3 * beads)  # velocities, spins
    difference = np.ptp(parts, axis=0).max(axis=1) / np.abs(parts).max(axis=(0, 2))
    return {
        "numpy_us": 1e6 * theirs["numpy_s"],
        "jax_us": 1e6 * theirs["jax_s"],
        "rpy_us": 1e6 * seconds[0],
        "rpy_motion_us": 1e6 * seconds[1],
        "numpy/rpy": theirs["numpy_s"] / seconds[0],
        "jax/rpy": theirs["jax_s"] / seconds[0],
        "numpy/rpy_motion": theirs["numpy_s"] / seconds[1],
        "jax/rpy_motion": theirs["jax_s"] / seconds[1],
        "difference": float(difference.max()),
        "jax_compile_s": theirs["compile_s"],
        "rpy_compile_s": compiling[0],
        "rpy_motion_compile_s": compiling[1],
    }


def settled(position: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """What became of the fibre: positions at equal times, `(times, beads, 3)`, from its first bead."""
    centre, ends = position.mean(axis=1), position[-1, -1] - position[-1, 0]
    return {
        "speed": float(centre[-2, 2] - centre[-1, 2]) / (STEP * STEPS),
        "slope_deg": float(np.degrees(np.arctan2(-ends[2], ends[0]))),
        "span/L": float(np.linalg.norm(ends)) / LENGTH,
        "difference/a": float(
            np.linalg.norm(position[-1] - reference[-1], axis=1).max() / RADIUS,
        ),
    }


def spatial(solution: jb.Solution) -> np.ndarray:
    """Positions in space with the first bead's start as origin; planar ones lie in x and z."""
    position = np.asarray(solution.states.position)
    if position.shape[-1] == 2:
        position = np.insert(position, 1, 0.0, axis=-1)
    return position - position[0, 0]


def ours(dim: int, **options: Any) -> tuple[dict[str, float], np.ndarray]:
    """Times of the fibre in jaxbeads, and its positions."""
    start = time.perf_counter()
    down, along = -np.eye(dim)[-1], np.eye(dim)[0]
    chain = jb.Chain(RADIUS, BEADS)
    forces = [Weight(WEIGHT * down), Bending(RIGIDITY)]
    scene = jb.Scene(chain, 1.0, constraints=[Gears()], forces=forces)
    state = jb.straight(chain, np.cos(ANGLE) * along + np.sin(ANGLE) * down)
    build_s = time.perf_counter() - start
    ts = np.linspace(0, STEP * STEPS * CALLS, CALLS + 1)

    def path(scene: jb.Scene, state: jb.State) -> jb.Solution:
        return jb.rollout(scene, state, ts, **options)

    program, compile_s = compiled(path, scene, state)
    path_s = median_seconds(lambda: program(scene, state), CALLS)
    solution = program(scene, state)
    if int(solution.code):
        sys.exit(f"jaxbeads stopped with code {int(solution.code)}")
    row = times(int(solution.steps), path_s, compile_s, build_s)
    return row, spatial(solution)


def times(steps: int, path_s: float, compile_s: float, build_s: float) -> dict[str, float]:
    return {
        "steps": steps,
        "step_us": 1e6 * path_s / steps,
        "path_s": path_s,
        "compile_s": compile_s,
        "build_s": build_s,
    }


def fibre(python: Path) -> dict[str, dict[str, float]]:
    """A row for each package, dimension and solver."""
    _, reference = ours(2, tolerance=1e-10)
    rows = {}
    for dim, kind in ((2, "plane"), (3, "space")):
        answer = ask(
            python,
            "softmobility",
            {
                "beads": BEADS,
                "radius": RADIUS,
                "weight": WEIGHT,
                "rigidity": RIGIDITY,
                "angle": ANGLE,
                "planar": dim == 2,
                "step": STEP,
                "steps": STEPS,
                "calls": CALLS,
            },
        )
        steps = STEPS * CALLS
        theirs = times(
            steps, steps * answer["step_s"], answer["compile_s"], answer["build_s"]
        ) | settled(np.array(answer["position"]), reference)
        rows[f"SoftMobility, {kind}"] = theirs | {"slip": answer["slip"]}
        for name, options in (("AB3", {"substeps": STEPS}), ("default", {})):
            row, position = ours(dim, **options)
            rows[f"jaxbeads {name}, {kind}"] = row | settled(position, reference)
    return rows


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    columns = ("numpy_us", "jax_us", "rpy_us", "rpy_motion_us")
    products = (
        [beads, *(duration(1e-6 * row[c]) for c in columns), order(row["difference"])]
        for beads, row in figures["mobility"].items()
    )
    head = ("beads", "pygrpy, NumPy", "pygrpy, JAX", "`rpy`", "`rpy_motion`", "difference")
    paths = (
        [
            name,
            str(row["steps"]),
            duration(row["path_s"]),
            duration(row["compile_s"]),
            number(row["speed"], 4),
            number(row["difference/a"]),
        ]
        for name, row in figures.get("fibre", {}).items()
    )
    fibres = ("", "steps", "path", "compiling", "speed", "difference/a")
    return {"peers": table(head, products), "peers-fibre": table(fibres, paths)}


def main() -> None:
    program = Program(__doc__, "N = 10 and 100, fewer calls, no SoftMobility")
    program.parser.add_argument(
        "--environments",
        type=Path,
        default=Path(tempfile.gettempdir()) / "jaxbeads-peers",
        metavar="FOLDER",
        help="where the other packages are installed, and found by the next run (default: %(default)s)",
    )
    arguments = program.arguments()
    folder = arguments.environments.resolve()
    python = environment(folder, "pygrpy")
    results: dict[str, Any] = {"mobility": {}}
    for beads in (10, 100) if arguments.quick else (10, 34, 100, 300):
        most = 201 if arguments.quick else 1001
        row = mobility(python, beads, int(np.clip(3e5 / beads**2, 31, most)))
        if not results["mobility"]:
            print(f"{'N':<6}" + "".join(f"{c:>{max(len(c), 8) + 2}}" for c in row))
        results["mobility"][beads] = row
        cells = "".join(f"{x:{max(len(c), 8) + 2}.3g}" for c, x in row.items())
        print(f"{beads:<6}" + cells, flush=True)
    rows = results["mobility"].values()
    results["difference"] = max(row["difference"] for row in rows)
    if arguments.quick:
        print("SoftMobility is left out by --quick: it compiles for minutes.")
    else:
        results["fibre"] = settling = fibre(environment(folder, "softmobility"))
        columns = list(settling["jaxbeads AB3, plane"])
        print(f"\n{'settling fibre, N = 10':<26}" + "".join(f"{c:>13}" for c in columns))
        for name, row in settling.items():
            print(f"{name:<26}" + "".join(f"{row[c]:13.5g}" for c in columns))
        ratios = results["ratios"] = {}
        for kind in ("plane", "space"):
            theirs = settling[f"SoftMobility, {kind}"]
            for name in ("AB3", "default"):
                row = settling[f"jaxbeads {name}, {kind}"]
                ratios[f"{name}, {kind}"] = ratio = {
                    c: theirs[c] / row[c] for c in ("step_us", "path_s", "compile_s")
                }
                cells = ", ".join(f"{c} {x:.3g}" for c, x in ratio.items())
                print(f"SoftMobility / jaxbeads {name}, {kind}: {cells}")
            slip = f"slip at contacts over surface speed {theirs['slip']:.2g}"
            print(f"SoftMobility, {kind}: {slip}")
        print(MODELS)
    program.end(results)


if __name__ == "__main__":
    main()
