"""Seconds from nothing to first results: import, programs, and the shell, each in a new process.

    python benchmarks/startup.py [--quick] [--json] [--save]

`import`, and the settling fibre (N = 34, B = 1000) for 1000 AB3 steps, compilation included: without a
cache of compiled programs (`cold`), and with `jaxbeads.enable_cache` and a folder that an earlier
process filled (`cached`). Then what JAX needs to make a program (to trace, to lower, to compile) of a
Gears fibre of 34 beads with weight and bending, in the plane and in space: one evaluation, AB3, the
default `rollout`, and gradients of a sum over its last state by all numbers of scene and start
(`.equal`: ten equal steps of `Rosenbrock`). Last `python -m jaxbeads settling` to its numbers, without
compiled programs and again with those of the first run. Medians of three processes (`--quick`: one, and
of the programs the default `rollout` and its gradient alone).
"""

import os
import statistics
import subprocess
import sys
import tempfile
from typing import Any

from record import Program, duration, table

IMPORT = "import time; t = time.perf_counter(); import jaxbeads; print(time.perf_counter() - t)"
FIRST = """
import sys, time; t = time.perf_counter()
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxbeads as jb
if len(sys.argv) > 1:
    jb.enable_cache(sys.argv[1])
case = jb.scenes.settling()
step = float(jb.solver.explicit_step(case.scene))
run = jb.simulate(case.scene, case.state, np.arange(11) * 100 * step, substeps=100, progress=False)
print(time.perf_counter() - t)
"""
PROGRAM = """
import sys, time
import jax; jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import jaxbeads as jb
from jaxbeads.constraint import Gears
from jaxbeads.dynamics import evaluate
from jaxbeads.force import Bending, Weight
which, dim = sys.argv[1], int(sys.argv[2])
chain = jb.Chain(1.0, 34)
forces = [Weight(-np.eye(dim)[1]), Bending(34 * 68.0**2 / 1000)]
scene = jb.Scene(chain, 1.0, constraints=[Gears()], forces=forces)
angle = 0.2 * np.sin(2 * np.pi * np.linspace(0, 1, 33))
tangents = np.stack([np.cos(angle), np.sin(angle), 0.3 * angle], axis=1)[:, :dim]
state = jb.State(jb.from_tangents(chain, tangents))
options = {"AB3": {"substeps": 100}, "equal": {"solver": jb.Rosenbrock(substeps=10)}}
def run(scene, state):
    chosen = options.get(which.split(".")[-1], {})
    return jb.rollout(scene, state, np.linspace(0, 100.0, 3), **chosen).final.position
def value(scene, state):
    return jnp.sum(run(scene, state) ** 2)
program = {
    "evaluation": lambda scene, state: evaluate(0.0, state, scene),
    "gradient": jax.value_and_grad(value, argnums=(0, 1)),
}.get(which.split(".")[0], run)
start = time.perf_counter()
jax.jit(program).trace(scene, state).lower().compile()
print(time.perf_counter() - start)
"""
PROGRAMS = ("evaluation", "rollout.AB3", "rollout", "gradient.AB3", "gradient.equal", "gradient")
QUICK = ("rollout", "gradient")
SHELL = """
import subprocess, sys, time; t = time.perf_counter()
words = [sys.executable, "-m", "jaxbeads", "settling", *sys.argv[1:]]
subprocess.run(words, check=True, capture_output=True)
print(time.perf_counter() - t)
"""


def seconds(program: str, rounds: int, *arguments: str, **environment: str) -> float:
    mine = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    runs = [
        subprocess.run(
            [sys.executable, "-c", program, *arguments],
            check=True,
            capture_output=True,
            text=True,
            env=mine | environment,
        )
        for _ in range(rounds)
    ]
    return statistics.median(float(run.stdout) for run in runs)


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    first = [
        ["`import jaxbeads`", duration(figures["import_s"]), ""],
        [
            "import, compile and 1000 AB3 steps of the settling fibre",
            duration(figures["cold_s"]),
            duration(figures["cached_s"]),
        ],
        [
            "`python -m jaxbeads settling`",
            duration(figures["shell"]),
            duration(figures["shell_again"]),
        ],
    ]
    names = {
        "evaluation": "one evaluation",
        "rollout.AB3": "a run by AB3",
        "rollout": "a run by the default solver",
        "gradient.AB3": "gradient of a run by AB3",
        "gradient.equal": "gradient of ten equal steps of `Rosenbrock`",
        "gradient": "gradient of a run by the default solver",
    }
    programs = (
        [text, *(duration(figures[f"{where}.{name}"]) for where in ("plane", "space"))]
        for name, text in names.items()
        if f"plane.{name}" in figures
    )
    return {
        "start-up": table(("", "without a cache", "programs of an earlier process"), first),
        "programs": table(("N = 34", "plane", "space"), programs),
    }


def main() -> None:
    asked = Program(__doc__, "one process each, fewer programs")
    quick, results = asked.arguments().quick, {}
    rounds = 1 if quick else 3

    def row(name: str, value: float) -> None:
        results[name] = value
        print(f"{name:<22}{value:6.2f} s", flush=True)

    row("import_s", seconds(IMPORT, rounds))
    row("cold_s", seconds(FIRST, rounds))
    with tempfile.TemporaryDirectory() as folder:
        seconds(FIRST, 1, folder)
        row("cached_s", seconds(FIRST, rounds, folder))
    for dim, where in ((2, "plane"), (3, "space")):
        for program in QUICK if quick else PROGRAMS:
            row(f"{where}.{program}", seconds(PROGRAM, rounds, program, str(dim)))
    row("shell", seconds(SHELL, rounds, "--no-cache"))
    with tempfile.TemporaryDirectory() as folder:
        seconds(SHELL, 1, XDG_CACHE_HOME=folder)
        row("shell_again", seconds(SHELL, rounds, XDG_CACHE_HOME=folder))
    asked.end(results)


if __name__ == "__main__":
    main()
