"""Time and error of kernels, batches and runs on an accelerator, beside the CPU of the same machine.

    python benchmarks/accelerator.py [--quick] [--json] [--save]

Settling Gears fibres (weight, bending, RPY with rotation), float64. Every program is compiled for the
first CPU device and for the first device of each other kind that jax finds; without one there is only
the column of the CPU. Times are medians of calls whose results are waited for; seconds of compiling are
those of the first call. Errors are over the largest number of the CPU's result: what the order of
summation makes of rounding, and nothing else, may part them.

- evaluation: velocities and spins of one fibre in space by a dense factorisation.
- batch: the same for 1024 fibres of 34 beads at once.
- AB3: 256 fibres in the plane, 20 beads, 200 equal steps; and their gradients by rigidity and weight.
- default: one fibre in the plane, 34 beads, that falls for 2 L/V_s by adaptive implicit steps.
- product: forces and torques of 10^4 beads to their motion, without a matrix; iterated: an evaluation
  of them, 100 fibres of 100.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gradient_cost import fibre
from record import Program, duration, order, table
from scaling import evaluation, median_ms, product, suspension

import jaxbeads as jb

jax.config.update("jax_enable_x64", True)


class Case(NamedTuple):
    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def final(scene: jb.Scene, state: jb.State, ts: jax.Array, substeps: int | None) -> jax.Array:
    return jb.rollout(scene, state, ts, substeps=substeps).final.position


def instants(quick: bool) -> list[Case]:
    cases = []
    for beads in (34, 300) if quick else (34, 100, 300, 1000):
        scene, state, _ = fibre(beads, 3)
        cases.append(Case(f"evaluation, N = {beads}", evaluation, (state, scene)))
    scene, state, _ = fibre(34, 3)
    shift = 0.01 * np.random.default_rng(0).normal(size=(1024, 1, 1))
    several = jax.vmap(lambda x: jb.State(state.position * (1 + 0.1 * x)))(jnp.asarray(shift))
    batch = eqx.filter_jit(lambda states, scene: jax.vmap(evaluation, (0, None))(states, scene)[0])
    return [*cases, Case("batch, 1024 x N = 34", batch, (several, scene))]


def runs(quick: bool) -> list[Case]:
    scene, state, _ = fibre(20, 2)
    ts = jnp.array([0.0, 200 * float(jb.solver.explicit_step(scene))])
    scales = jnp.asarray(1 + 0.1 * np.random.default_rng(1).normal(size=(256, 2)))

    def value(scales: jax.Array, scene: jb.Scene, state: jb.State) -> jax.Array:
        weight, bending = scene.forces
        scene = eqx.tree_at(
            lambda s: (s.forces[0].force, s.forces[1].rigidity),
            scene,
            (scales[0] * weight.force, scales[1] * bending.rigidity),
        )
        return final(scene, state, ts, 200)

    def slope(scales: jax.Array, scene: jb.Scene, state: jb.State) -> jax.Array:
        return jax.grad(lambda x: jnp.sum(value(x, scene, state) ** 2))(scales)

    members = (scales, scene, state)
    over = (0, None, None)
    one, start, unit = fibre(34, 2)
    times = jnp.linspace(0.0, 2 * unit, 11)
    return [
        Case("AB3, 256 x N = 20", eqx.filter_jit(jax.vmap(value, over)), members),
        Case("its gradients", eqx.filter_jit(jax.vmap(slope, over)), members),
        Case("default, N = 34", eqx.filter_jit(final), (one, start, times, None)),
    ]


def large(quick: bool) -> list[Case]:
    scene, state = suspension((100,) * (10 if quick else 100))
    rng, shape = np.random.default_rng(2), state.position.shape
    load = jb.Load(*(jnp.asarray(rng.normal(size=shape)) for _ in range(2)))
    beads = len(state.position)
    return [
        Case(f"product, {beads} beads", product, (state, scene, load)),
        Case(f"iterated, {beads} beads", evaluation, (state, scene)),
    ]


def devices() -> dict[str, jax.Device]:
    """The first CPU device, and the first of each other kind."""
    found = {"cpu": jax.devices("cpu")[0]}
    for device in jax.devices():
        found.setdefault(device.platform, device)
    return found


def flat(result: Any) -> np.ndarray:
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(result)])


def measure(case: Case) -> dict[str, dict[str, float]]:
    """Compile seconds, milliseconds and error of a case for each device."""
    rows: dict[str, dict[str, float]] = {}
    expected = np.zeros(0)
    for kind, device in devices().items():
        placed = jax.device_put(case.arguments, device)
        with jax.default_device(device):
            start = time.perf_counter()
            result = flat(jax.block_until_ready(case.function(*placed)))
            first = time.perf_counter() - start
            ms = median_ms(case.function, *placed)
        if kind == "cpu":
            expected = result
        error = float(np.abs(result - expected).max() / np.abs(expected).max())
        rows[kind] = {"ms": ms, "compile_s": first - 1e-3 * ms, "error": error}
    return rows


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    kinds = [kind for kind in figures["devices"] if kind != "cpu"]
    head = [""]
    for kind in kinds:
        head += [figures["devices"][kind], "compiling", "error"]
    head += ["CPU of that machine", "compiling"]
    rows = []
    for name, row in figures["rows"].items():
        cells = [name]
        for kind in (*kinds, "cpu"):
            found = row[kind]
            cells += [duration(1e-3 * found["ms"]), duration(found["compile_s"])]
            cells += [order(found["error"])] * (kind != "cpu")
        rows.append(cells)
    return {"accelerators": table(head, rows)}


def main() -> None:
    program = Program(__doc__, "fewer sizes, 1000 beads at most")
    arguments = program.arguments()
    found = devices()
    print(", ".join(f"{kind}: {device.device_kind}" for kind, device in found.items()))
    print(f"{'':<26}{'device':<8}{'ms':>12}{'over CPU':>10}{'compile s':>11}{'error':>10}")
    rows = {}
    for part in (instants, large, runs):
        for case in part(arguments.quick):
            rows[case.name] = measure(case)
            for kind, row in rows[case.name].items():
                ratio = row["ms"] / rows[case.name]["cpu"]["ms"]
                print(
                    f"{case.name:<26}{kind:<8}{row['ms']:12.4g}{ratio:10.3g}"
                    f"{row['compile_s']:11.1f}{row['error']:10.1e}",
                    flush=True,
                )
    kinds = {kind: device.device_kind for kind, device in found.items()}
    program.end({"devices": kinds, "rows": rows}, rows)


if __name__ == "__main__":
    main()
