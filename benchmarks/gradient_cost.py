"""Cost, memory and error of gradients against the forward run.

    python benchmarks/gradient_cost.py [--quick] [--json] [--save]

A Gears fibre (RPY, weight, bending) settles; the value is a fixed sum of its last positions, and the
gradient is by the rigidity of every joint, an intrinsic curvature of every joint, viscosity and weight.
Time: medians, in turns, of the forward run, of value and gradient in reverse, and of value and one
derivative in forward mode. Memory is what the compiled gradient needs beside arguments and results.
Errors: reverse against central differences of fourth order along a random direction, and against
forward mode along it, relative; with adaptive steps differences are as rough as the tolerance, 1e-6,
lets the steps change. Rows of `ESDIRK` are of a cloud, by viscosity and rigidity; not in `--quick`, as
their programs take minutes to compile. The last rows are implicit derivatives: of a steady shape by
Newton's method, and of a periodic swimmer by shooting.

Unless XLA_FLAGS is set, fusions are compiled by XLA's older code generator, as `README.md` here says of
gradients; `XLA_FLAGS= python ...` measures the default.
"""

import os
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from record import Program, duration, number, order, table

import jaxbeads as jb
from jaxbeads.constraint import Gears
from jaxbeads.force import Bending, Weight

jax.config.update("jax_enable_x64", True)


class Case(NamedTuple):
    name: str
    value: Callable[[Any], jax.Array]
    start: Any
    size: float = 1e-3
    """Of the relative change in the differences."""
    steps: int = 0


def fibre(beads: int, dim: int, number: float = 1000.0) -> tuple[jb.Scene, jb.State, float]:
    """A settling fibre, its start, and the time in which it settles by its length."""
    chain = jb.Chain(1.0, beads)
    length = 2.0 * beads
    rigidity = np.full(beads - 2, beads * length**2 / number)
    s = np.linspace(0, 1, beads - 2)
    rest = 0.1 / length * np.sin(3 * s)
    rest = rest if dim == 2 else np.stack([rest, 0.5 * rest[::-1]], axis=1)
    weight = Weight(-np.eye(dim)[1])
    bending = Bending(rigidity, rest)
    scene = jb.Scene(chain, 1.0, constraints=[Gears()], forces=[weight, bending])
    angle = 0.2 * np.sin(2 * np.pi * np.linspace(0, 1, beads - 1))
    tangents = np.stack([np.cos(angle), np.sin(angle), 0.3 * angle], axis=1)[:, :dim]
    return scene, jb.State(jb.from_tangents(chain, tangents)), 6 * np.pi * length / 3


def leaves(scene: jb.Scene) -> tuple[jax.Array, ...]:
    weight, bending = scene.forces
    return bending.rigidity, bending.intrinsic_curvature, scene.viscosity, weight.force


def varied(name: str, scene: jb.Scene, final: Callable[[jb.Scene], jax.Array], steps: int) -> Case:
    weights = np.random.default_rng(0).normal(size=final(scene).shape)
    value = jb.vary(lambda scene: jnp.sum(weights * final(scene)), scene, leaves)
    return Case(name, value, value.start, steps=steps)


def settling(
    beads: int, dim: int, steps: int, kind: Any = jb.AB3, duration: float | None = None
) -> Case:
    """Equal steps: of AB3 near its limit, or of another solver in a time given in L/V_s."""
    scene, state, unit = fibre(beads, dim)
    limit = float(jb.solver.explicit_step(scene))
    ts = np.array([0.0, 1.5 * limit * steps if duration is None else duration * unit])

    def final(scene: jb.Scene) -> jax.Array:
        return jb.rollout(scene, state, ts, solver=kind(substeps=steps)).final.position

    name = f"{kind.__name__}, {dim}-D, N = {beads}"
    return varied(f"{name}, {steps} steps", scene, final, steps)


def adaptive(beads: int, tolerance: float) -> Case:
    scene, state, unit = fibre(beads, 2)

    def run(scene: jb.Scene) -> jb.Solution:
        return jb.rollout(scene, state, np.array([0.0, 2 * unit]), tolerance=tolerance)

    steps = int(run(scene).steps)
    name = f"default, adaptive, N = {beads}, {steps} steps"
    return varied(name, scene, lambda s: run(s).final.position, steps)


def cloud(fibres: int, beads: int, steps: int | None) -> Case:
    """Fibres that settle together, by equal steps of `ESDIRK`, or by those that it chooses."""
    case = jb.scenes.cloud(fibres, beads, 1000.0, 0.5)
    state, end = case.state, float(case.ts[-1])
    solver = jb.ESDIRK(tolerance=1e-4) if steps is None else jb.ESDIRK(substeps=steps)
    ts = np.array([0.0, 0.25 * end if steps is None else 0.025 * end * steps])

    def run(scene: jb.Scene) -> jb.Solution:
        return jb.rollout(scene, state, ts, solver=solver)

    taken = int(run(case.scene).steps)
    name = f"ESDIRK{'' if steps else ', adaptive'}, {fibres} x {beads}, {taken} steps"
    weights = np.random.default_rng(0).normal(size=state.position.shape)
    value = jb.vary(
        lambda scene: jnp.sum(weights * run(scene).final.position),
        case.scene,
        lambda scene: (scene.viscosity, scene.forces[1].rigidity),
    )
    return Case(name, value, value.start, 1e-4, taken)


def steady(beads: int) -> Case:
    scene, state, unit = fibre(beads, 2, 300.0)
    guess = jb.rollout(scene, state, np.array([0.0, 8 * unit])).final

    def final(scene: jb.Scene) -> jax.Array:
        position = jb.steady_state(scene, guess).state.position
        return position - position[:1]

    return varied(f"steady state, N = {beads}", scene, final, 0)


def periodic(beads: int) -> Case:
    case = jb.scenes.nematode(beads)
    guess = jb.rollout(case.scene, case.state, np.array([0.0, 2.0])).final

    def swum(scene: jb.Scene) -> jax.Array:
        cycle = jb.periodic_state(scene, guess, 1.0, substeps=100)
        return jnp.linalg.norm(cycle.displacement)

    value = jb.vary(swum, case.scene, lambda s: s.forces[0].intrinsic_curvature.amplitude)
    return Case(f"periodic state, nematode, N = {beads}", value, value.start)


def seconds(function: Callable[..., Any], *arguments: Any) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


def measure(case: Case, rounds: int) -> dict[str, float]:
    rng = np.random.default_rng(1)
    direction = jax.tree.map(
        lambda x: jnp.asarray((np.abs(x) + 1e-3) * rng.normal(size=x.shape)), case.start
    )

    def along(values: Any) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(case.value, (values,), (direction,))

    start = time.perf_counter()
    reverse = jax.jit(jax.value_and_grad(case.value)).lower(case.start).compile()
    compile_s = time.perf_counter() - start
    forward, tangent = jax.jit(case.value), jax.jit(along)
    functions = forward, reverse, tangent
    for function in functions:
        function(case.start)  # warm
    times: list[list[float]] = [[], [], []]
    for _ in range(rounds):
        for kept, function in zip(times, functions, strict=True):
            kept.append(seconds(function, case.start))
    run, both, one = (statistics.median(t) for t in times)
    slopes = jax.tree.map(jnp.vdot, reverse(case.start)[1], direction)
    slope = float(sum(jax.tree.leaves(slopes)))
    pushed = float(tangent(case.start)[1])
    h = case.size

    def moved(k: int) -> float:
        return float(forward(jax.tree.map(lambda x, d: x + k * h * d, case.start, direction)))

    difference = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h)
    return {
        "forward_s": run,
        "gradient_s": both,
        "cost_ratio": both / run,
        "tangent_ratio": one / run,
        "memory_mib": reverse.memory_analysis().temp_size_in_bytes / 2**20,
        "fd_error": abs(slope / difference - 1),
        "mode_error": abs(slope / pushed - 1),
        "compile_s": compile_s,
    }


def cases(quick: bool) -> list[Callable[[], Case]]:
    first = [lambda: settling(20, 2, 1_000), lambda: settling(20, 2, 10_000)]
    last = [
        lambda: settling(20, 2, 100, jb.Rosenbrock, 10.0),
        lambda: adaptive(20, 1e-6),
        lambda: steady(20),
    ]
    if quick:
        return [*first, *last]
    return [
        *first,
        lambda: settling(10, 2, 1_000),
        lambda: settling(50, 2, 1_000),
        lambda: settling(100, 2, 1_000),
        lambda: settling(20, 2, 100),
        lambda: settling(20, 3, 1_000),
        lambda: settling(50, 3, 1_000),
        lambda: settling(20, 2, 1_000, jb.Rosenbrock, 10.0),
        lambda: cloud(8, 20, 4),
        lambda: cloud(8, 20, None),
        *last,
        lambda: periodic(12),
    ]


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    head = (
        "",
        "value",
        "value and gradient over it",
        "forward mode, each number",
        "memory",
        "to differences",
        "between modes",
        "compiling",
    )
    rows = (
        [
            name,
            duration(row["forward_s"]),
            number(row["cost_ratio"]),
            number(row["tangent_ratio"]),
            f"{number(row['memory_mib'])} MiB",
            order(row["fd_error"]),
            order(row["mode_error"]),
            duration(row["compile_s"]),
        ]
        for name, row in figures["rows"].items()
    )
    return {"gradients": table(head, rows)}


SHOWN = {
    "AB3": ("AB3, 2-D, N = 20, 1000 steps", "cost_ratio"),
    "substeps": ("Rosenbrock, 2-D, N = 20, 100 steps", "cost_ratio"),
    "adaptive": ("default, adaptive", "cost_ratio"),
    "steady": ("steady state", "cost_ratio"),
    "periodic": ("periodic state", "cost_ratio"),
    "AB3-forward": ("AB3, 2-D, N = 20, 1000 steps", "tangent_ratio"),
    "adaptive-forward": ("default, adaptive", "tangent_ratio"),
}
"""Numbers of the README: the case, by what its name begins with, and its column."""


def values(figures: dict[str, Any]) -> dict[str, str]:
    rows, found = figures["rows"], {}
    for name, (begin, column) in SHOWN.items():
        row = next((row for case, row in rows.items() if case.startswith(begin)), {})
        found[f"gradient-{name}"] = number(row[column]) if row else "(not measured)"
    return found


def main() -> None:
    program = Program(__doc__, "N = 20 in the plane, one case of each kind; no periodic state")
    arguments = program.arguments()
    os.environ.setdefault(
        "XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false"
    )  # read by the first use
    rows = {}
    for build in cases(arguments.quick):
        case = build()
        row = measure(case, 5 if arguments.quick else 7)
        if not rows:
            print(f"{'case':<40}" + "".join(f"{c:>14}" for c in row))
        rows[case.name] = row
        print(f"{case.name:<40}" + "".join(f"{x:14.3g}" for x in row.values()), flush=True)
    first, longer, *_ = rows.values()
    result = {
        "cost_ratio": first["cost_ratio"],
        "memory_ratio": longer["memory_mib"] / first["memory_mib"],
        "fd_error": max(first["fd_error"], longer["fd_error"]),
    }
    program.end({**result, "rows": rows}, result)


if __name__ == "__main__":
    main()
