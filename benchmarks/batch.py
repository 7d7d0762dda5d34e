"""Cost of a member: alone in a Python loop, in a batch by `vmap`, and in a sweep.

    python benchmarks/batch.py [--quick] [--json] [--save]

256 settling Gears fibres (N = 20) of different viscosity, by equal steps (AB3) and by steps that each
chooses (the default). The loop calls a compiled function of one member. A batch is the `vmap` of that
function, 64 members at a time, on one device. Sweeps run on one device and on two (each a share of the
CPU's cores), 16 members at a time; they are timed from the first chunk that is written to the last.
Medians, in turns; compiling is left out everywhere. `per_member_ratio` is the largest ratio to the
loop of the sweep on two devices. The error is the largest difference from the loop's positions, over a
radius.
"""

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gradient_cost import fibre
from record import Program, duration, number, order, table

import jaxbeads as jb

jax.config.update("jax_enable_x64", True)
SIDES, CHUNK = 64, 16


def seconds(function: Callable[..., Any], rounds: int) -> float:
    jax.block_until_ready(function())  # warm
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def swept(build: Any, values: np.ndarray, ts: Any, devices: int, options: dict[str, Any]) -> Any:
    """Seconds for a member, and all positions."""

    def measure(run: jb.Solution, scene: jb.Scene) -> dict[str, jax.Array]:
        return {"position": run.final.position}

    with tempfile.TemporaryDirectory() as folder:
        table = jb.sweep(
            build,
            {"viscosity": values},
            ts,
            measure,
            chunk=CHUNK,
            folder=folder,
            devices=jax.devices()[:devices],
            progress=False,
            **options,
        )
        written = sorted(path.stat().st_mtime for path in Path(folder).glob("chunk_*.npz"))
    done = CHUNK * (len(written) - devices)
    return (written[-1] - written[devices - 1]) / done, table.position.values


def measure(adaptive: bool, members: int, rounds: int) -> dict[str, float]:
    scene, state, unit = fibre(20, 2)
    step = 0.5 * float(jb.solver.explicit_step(scene))
    ts = jnp.array([0.0, 3 * unit if adaptive else 1000 * step])
    options: dict[str, Any] = {} if adaptive else {"substeps": 1000}
    values = np.linspace(1.0, 2.0, members)

    def build(viscosity: jax.Array) -> tuple[jb.Scene, jb.State]:
        return eqx.tree_at(lambda s: s.viscosity, scene, viscosity), state

    def final(viscosity: jax.Array) -> jax.Array:
        return jb.rollout(*build(viscosity), ts, **options).final.position

    single, batch = jax.jit(final), jax.jit(jax.vmap(final))
    few = values[:: members // SIDES]
    side = seconds(lambda: batch(few), rounds) / len(few)
    turns, positions = [], values
    for _ in range(rounds):
        loop = seconds(lambda: [single(v) for v in few], 1) / len(few)
        one, positions = swept(build, values, ts, 1, options)
        turns.append((loop, one, swept(build, values, ts, 2, options)[0]))
    loop, one, two = (statistics.median(t) for t in zip(*turns, strict=True))
    reference = np.stack([single(v) for v in values])
    return {
        "loop_ms": 1e3 * loop,
        "vmap_ratio": side / loop,
        "sweep_ratio": one / loop,
        "two_devices_ratio": two / loop,
        "error": float(np.abs(positions - reference).max()),
    }


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    head = ("", "loop", "`vmap`, 64 at a time", "sweep, one device", "sweep, two devices", "error")
    ratios = ("vmap_ratio", "sweep_ratio", "two_devices_ratio")
    rows = (
        [
            name,
            duration(1e-3 * row["loop_ms"]),
            *(number(row[c]) for c in ratios),
            order(row["error"]),
        ]
        for name, row in figures["rows"].items()
    )
    return {"batches": table(head, rows)}


def main() -> None:
    jax.config.update("jax_num_cpu_devices", 2)
    program = Program(__doc__, "fewer rounds")
    arguments = program.arguments()
    rounds = 3 if arguments.quick else 9
    rows = {"equal steps": False, "own steps": True}
    results = {name: measure(adaptive, 256, rounds) for name, adaptive in rows.items()}
    columns = list(results["own steps"])
    print(f"{'':14}" + "".join(f"{c:>19}" for c in columns))
    for name, row in results.items():
        print(f"{name:14}" + "".join(f"{row[c]:19.3g}" for c in columns))
    ratio = max(row["two_devices_ratio"] for row in results.values())
    program.end({"per_member_ratio": ratio, "rows": results})


if __name__ == "__main__":
    main()
