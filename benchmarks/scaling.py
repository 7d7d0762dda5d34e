"""Time, memory, iterations and error of an instant, a step and a run of many fibres, up to 10^4 beads.

    python benchmarks/scaling.py [--quick] [--json] [--save]

Settling Gears fibres in space (weight, bending, RPY with rotation), bent to an S. Without dense matrices
(`RPY(dense=False)`): one product of the mobility with forces and torques (6N numbers), an evaluation
(loads, multipliers by iterations, velocities and spins), and its value with the gradient by all numbers
of scene and state; and a dense evaluation where that is practical. The error is the largest difference
of the velocities from the dense ones, over the largest. Two checks stand for it at any size: the
residual, the largest slip of the constraints over the largest velocity, and the product's error at
sampled beads, whose velocities NumPy sums from the tensors of pairs. Memory is what the compiled
gradient needs beside its arguments; `memory_gib` is the most that the whole process ever had. Exponents
are slopes of log time over log N from 1000 beads on.

Products with an error that is asked for (`RPY(far_error=1e-6)`), of fibres of 100 beads on a lattice:
seconds beside those of the exact sum, and the error, the largest of velocities and of spins over the
largest. `product_1e4_s` and `product_1e5_s` are these. Coarse products are those that stages iterate.

A step of `ESDIRK`, of 0.02 of the time in which a fibre falls by its length, after twice as long a fall,
of a fibre of 1000 beads in the plane (B = 1000) and of bent ones: seconds of the step and of a stage,
products with the mobility in a stage (coarse ones, too), error of the beads' way, over the largest,
against iterations that go on to 1e-11, of exact sums. `stage_s` and `stage_error` are those of the many
fibres, whose sums have a `far_error` of 1e-6.

A cloud (the scene of that name, B = 1000, half a length apart) falls by two lengths: steps, products,
seconds of the run and of compiling, and its error, the largest distance of a bead over L from where it
is with a tenth of the tolerance. `many_ratio` is the number of AB3's steps at (39) over that of stages.
"""

import json
import resource
import statistics
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from record import Program, duration, number, order, table

import jaxbeads as jb
from jaxbeads import dynamics, saddle, scenes, tensors
from jaxbeads.constraint import Gears
from jaxbeads.force import Bending, Weight
from jaxbeads.iterations import conjugate_gradients
from jaxbeads.mobility import RPY
from jaxbeads.rollout import stepper_for
from jaxbeads.solver.esdirk import Esdirk

jax.config.update("jax_enable_x64", True)
MOST_DENSE = 1000
STAGE_TOLERANCE = 1e-5
FAR = 1e-6
COLUMNS = ("product_ms", "evaluation_ms", "dense_ms", "gradient_ms", "iterations")
ERRORS = ("error", "residual", "product_error", "memory_mib")


def suspension(fibres: tuple[int, ...]) -> tuple[jb.Scene, jb.State]:
    """Fibres on a lattice, each bent to an S in a plane of its own."""
    chain, rng = jb.Chain(1.0, fibres), np.random.default_rng(0)
    tangents = []
    for beads in fibres:
        s = np.linspace(0, 1, beads)
        angle, plane = 0.5 * np.sin(2 * np.pi * s), rng.uniform(0, 2 * np.pi)
        up, aside = np.sin(angle), 0.3 * np.cos(2 * angle)
        turned = (
            np.cos(plane) * up - np.sin(plane) * aside,
            np.sin(plane) * up + np.cos(plane) * aside,
        )
        tangents.append(np.stack([np.cos(angle), *turned], axis=1))
    shape = (4, 5, 5) if len(fibres) <= 100 else (10, 10, 10)
    places = np.stack(np.unravel_index(np.arange(len(fibres)), shape), axis=1)
    centres = places * np.array([2.2 * max(fibres), 0.8 * max(fibres), 0.8 * max(fibres)])
    scene = jb.Scene(
        chain,
        1.0,
        RPY(dense=False),
        constraints=[Gears()],
        forces=[Weight([0.0, -1.0, 0.0]), Bending(float(max(fibres)))],
    )
    return scene, jb.State(jb.from_tangents(chain, np.concatenate(tangents)[:-1], centres))


def median_ms(function: Any, *arguments: Any, budget: float = 2.0) -> float:
    """Median of as many rounds as fit into some seconds; at least one."""
    times: list[float] = []
    while not times or sum(times) < budget:
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


@eqx.filter_jit
def evaluation(state: jb.State, scene: jb.Scene) -> tuple[jb.Motion, jax.Array]:
    """The motion, and the largest slip of its constraints."""
    moved = dynamics.motion(0.0, state, scene)
    slip = saddle.slips(0.0, state, scene)(moved)
    return moved, jnp.max(jnp.abs(slip)) / jnp.max(jnp.abs(moved.velocity))


@eqx.filter_jit
def count(state: jb.State, scene: jb.Scene) -> jax.Array:
    """Iterations for the multipliers."""
    operator = scene.operator(state)
    system = saddle.saddle_point(0.0, state, scene, operator)
    j, precondition = system.constraints, system.solver.precondition
    rhs = -j.slip(dynamics.free_motion(0.0, state, scene, operator))
    return conjugate_gradients(lambda x: j.compliance(operator, x), rhs, precondition).iterations


@jax.jit
def product(state: jb.State, scene: jb.Scene, load: jb.Load) -> jb.Motion:
    return scene.operator(state).product(load, exact=False)


@jax.jit
def roughly(state: jb.State, scene: jb.Scene, load: jb.Load) -> jb.Motion | None:
    return scene.operator(state).coarse(load)


gradient = jax.jit(
    lambda both: eqx.filter_value_and_grad(
        lambda both: jnp.sum(dynamics.motion(0.0, *both).velocity[::7] ** 2)
    )(both)
)


def sampled_error(state: jb.State, scene: jb.Scene, load: jb.Load, moved: jb.Motion) -> float:
    """Error of some beads' velocities against sums in NumPy of the tensors of pairs, each by itself."""
    x, worst = state.position, 0.0
    radius, viscosity = scene.chain.radius, scene.viscosity
    alone = jax.jit(jax.vmap(lambda pair: tensors.rpy(jb.Configuration(pair, radius, viscosity))))
    for bead in np.random.default_rng(1).choice(len(x), 3, replace=False):
        others = np.arange(len(x)) != bead
        tensor = alone(jnp.stack([jnp.broadcast_to(x[bead], x.shape), x], axis=1))
        velocity = np.zeros(3)
        for i in range(3):
            for j in range(3):
                field = np.asarray(tensor.tt[i][j])
                entries = np.where(others, field[:, 0, 1], field[:, 0, 0])
                velocity[i] += entries @ np.asarray(load.force)[:, j]
                if (entry := tensor.tr[i][j]) is not None:
                    field = entry.sign * np.asarray(entry.field)[:, 0, 1] * others
                    velocity[i] += field @ np.asarray(load.torque)[:, j]
        error = np.abs(velocity - moved.velocity[bead]).max()
        worst = max(worst, float(error / np.abs(moved.velocity).max()))
    return worst


def measure(fibres: tuple[int, ...], gradients: bool) -> dict[str, float]:
    scene, state = suspension(fibres)
    beads, rng = scene.chain.beads, np.random.default_rng(2)
    load = jb.Load(*(jnp.asarray(rng.normal(size=(beads, 3))) for _ in range(2)))
    moved, residual = evaluation(state, scene)
    pushed = product(state, scene, load)
    row = {
        "product_ms": median_ms(product, state, scene, load),
        "evaluation_ms": median_ms(evaluation, state, scene),
        "iterations": int(count(state, scene)),
        "residual": float(residual),
        "product_error": sampled_error(state, scene, load, pushed),
    }
    if gradients:
        compiled = gradient.lower((state, scene)).compile()
        row["memory_mib"] = compiled.memory_analysis().temp_size_in_bytes / 2**20
        jax.block_until_ready(gradient((state, scene)))
        row["gradient_ms"] = median_ms(gradient, (state, scene))
    if beads <= MOST_DENSE:
        dense = eqx.tree_at(lambda s: s.mobility, scene, RPY(dense=True))
        expected = evaluation(state, dense)[0].velocity
        row["error"] = float(jnp.abs(moved.velocity - expected).max() / jnp.abs(expected).max())
        row["dense_ms"] = median_ms(evaluation, state, dense)
    return row


def fast(scene: jb.Scene) -> jb.Scene:
    """The same with an error that beads far away may have."""
    return eqx.tree_at(lambda s: s.mobility, scene, RPY(dense=False, far_error=FAR))


def pushed(fibres: int) -> dict[str, float]:
    """Products of so many fibres of 100 beads."""
    scene, state = suspension((100,) * fibres)
    rng = np.random.default_rng(2)
    load = jb.Load(*(jnp.asarray(rng.normal(size=state.position.shape)) for _ in range(2)))
    exact, moved = product(state, scene, load), product(state, fast(scene), load)
    coarse = roughly(state, fast(scene), load)

    def error(moved: jb.Motion) -> float:
        pairs = (moved.velocity, exact.velocity), (moved.spin, exact.spin)
        return max(float(jnp.abs(a - b).max() / jnp.abs(b).max()) for a, b in pairs)

    row = {
        "exact_s": 1e-3 * median_ms(product, state, scene, load),
        "fast_s": 1e-3 * median_ms(product, state, fast(scene), load),
        "error": error(moved),
    }
    if coarse is not None:
        row["coarse_s"] = 1e-3 * median_ms(roughly, state, fast(scene), load)
        row["coarse_error"] = error(coarse)
    return row


@eqx.filter_jit
def after(stepper: Any, scene: jb.Scene, state: jb.State, ts: jax.Array) -> Any:
    """The carry of a run from one time to another."""
    carry = stepper.init(scene, state, ts[0], ts[1])
    return stepper.stretch(scene, carry, ts[0], ts[1], stepper.max_steps)


def stage(scene: jb.Scene, state: jb.State, taken: jb.Scene) -> dict[str, float]:
    """A step of `ESDIRK` in a scene whose sums are those of another, or near."""
    beads = max(scene.chain.fibres)
    alone = scenes.settling(beads).scene
    h = 0.02 * 2.0 * float(scenes.settling_friction(alone))  # 0.02 L/V_s, weight 1 a bead
    # To the end of a step: between steps states are interpolated, with errors in stiff modes.
    ts = jnp.array([0.0, 2 * h])
    stepper = stepper_for(scene, ts, jb.ESDIRK(tolerance=STAGE_TOLERANCE))
    state = after(stepper, scene, state, ts).memory.state

    @eqx.filter_jit
    def begun(scheme: Any, state: jb.State, scene: jb.Scene) -> Any:
        memory = scheme.init(None, 0.0, h, state, scene)
        return scheme.step(None, 0.0, h, state, scene, memory, False)

    def way(tolerance: float, scene: jb.Scene) -> tuple[np.ndarray, int]:
        end, _, _, memory, _ = begun(Esdirk(jnp.asarray(tolerance)), state, scene)
        return np.asarray(end.position - state.position), int(memory.products)

    found, products = way(STAGE_TOLERANCE, taken)
    exact, _ = way(1e-10, scene)
    step = Esdirk(jnp.asarray(STAGE_TOLERANCE))
    seconds = 1e-3 * median_ms(begun, step, state, taken)
    return {
        "step_s": seconds,
        "stage_s": seconds / 6,
        "products": products / 6,
        "stage_error": float(np.abs(found - exact).max() / np.abs(exact).max()),
    }


def cloud(fibres: int, beads: int, tolerance: float) -> dict[str, float]:
    """A cloud falls by two lengths."""
    case = scenes.cloud(fibres, beads, 1000.0, 0.5)
    scene, state, ts = case.scene, case.state, jnp.asarray(case.ts[[0, -1]])
    length, ends, found = float(scene.chain.length[0]), [], {}
    for asked in (tolerance, 0.1 * tolerance):
        stepper = stepper_for(scene, ts, jb.ESDIRK(tolerance=asked))

        start = time.perf_counter()
        compiled = after.lower(stepper, scene, state, ts).compile()
        middle = time.perf_counter()
        carry = jax.block_until_ready(compiled(stepper, scene, state, ts))
        end = time.perf_counter()
        ends.append(np.asarray(carry.state.position))
        if not found:
            ab3 = float(ts[1] - ts[0]) / float(jb.solver.explicit_step(scene))
            steps = int(carry.steps)
            found = {
                "fibres": fibres,
                "beads": beads,
                "tolerance": tolerance,
                "steps": steps,
                "products_kept": int(carry.memory.solver.products),
                "code": int(carry.code),
                "ratio": ab3 / (6 * steps),
                "wall_s": end - start,
                "compile_s": middle - start,
            }
    off = np.linalg.norm(ends[0] - ends[1], axis=1).max() / length
    return {**found, "error": float(off)}


def slope(rows: dict[str, dict[str, float]], name: str) -> float:
    """Exponent of a column against the number of beads, from 1000 beads on."""
    pairs = [(int(n), row[name]) for n, row in rows.items() if int(n) >= 1000 and name in row]
    return float(np.polyfit(*np.log(np.array(pairs).T), 1)[0])


def line(label: str, row: dict[str, float]) -> None:
    cells = (f"{row[c]:14.3g}" if c in row else f"{'-':>14}" for c in (*COLUMNS, *ERRORS))
    print(f"{label:<10}" + "".join(cells), flush=True)


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    head = (
        "beads",
        "product of M, 6N numbers",
        "evaluation",
        "dense",
        "value and gradient",
        "iterations",
        "error",
        "residual",
        "error of the product",
        "memory of the gradient",
    )
    rows = []
    for name, row in figures["rows"].items():
        times = (row[c] * 1e-3 if c in row else None for c in COLUMNS[:-1])
        errors = (row.get(c) for c in ERRORS[:-1])
        memory = f"{number(row['memory_mib'])} MiB" if "memory_mib" in row else "-"
        cells = [*map(duration, times), str(row["iterations"]), *map(order, errors), memory]
        label = f"{figures['fibres']} fibres of 100" if name == "many" else name
        rows.append([label, *cells])
    steps = [
        [
            name,
            duration(row["step_s"]),
            duration(row["stage_s"]),
            number(row["products"]),
            order(row["stage_error"]),
        ]
        for name, row in figures["stages"].items()
    ]
    sums = [
        [
            name,
            *(duration(row[key]) for key in ("exact_s", "fast_s")),
            order(row["error"]),
            duration(row.get("coarse_s")),
            order(row.get("coarse_error")),
        ]
        for name, row in figures["products"].items()
    ]
    fallen = figures["cloud"]
    run = [
        f"{fallen['fibres']} x {fallen['beads']}",
        str(fallen["steps"]),
        str(fallen["products_kept"]),
        duration(fallen["wall_s"]),
        duration(fallen["compile_s"]),
        order(fallen["error"]),
        number(fallen["ratio"]),
    ]
    heads = (
        ("beads", "exact product", "with `far_error=1e-6`", "error", "coarse", "error"),
        ("beads", "step", "stage", "products in a stage", "error of the way"),
        (
            "cloud",
            "steps",
            "products",
            "run",
            "of it compiling",
            "error",
            "AB3's steps over stages",
        ),
    )
    return {
        "large-scenes": table(head, rows),
        "fast-sums": table(heads[0], sums),
        "large-steps": table(heads[1], steps),
        "clouds": table(heads[2], [run]),
    }


def main() -> None:
    program = Program(__doc__, "fewer sizes, no gradient at 10^4, no run")
    arguments = program.arguments()
    sizes = (100, 1000, 3000, 10_000) if arguments.quick else (10, 30, 100, 300, 1000, 3000, 10_000)
    print(f"{'beads':<10}" + "".join(f"{c:>14}" for c in (*COLUMNS, *ERRORS)))
    rows = {}
    for beads in sizes:
        rows[str(beads)] = measure((beads,), beads <= 3000 or not arguments.quick)
        line(str(beads), rows[str(beads)])
    fibres = 20 if arguments.quick else 100
    many = measure((100,) * fibres, False)
    line(f"{fibres} x 100", many)
    long, several = scenes.settling(1000, 1000.0), suspension((100,) * fibres)
    products = {}
    for number_of in (20, 100) if arguments.quick else (20, 100, 300, 1000):
        products[f"{number_of} x 100"] = pushed(number_of)
        print(
            f"{number_of} x 100: products", json.dumps(products[f"{number_of} x 100"]), flush=True
        )
    stages = {
        "1000, planar": stage(long.scene, long.state, long.scene),
        f"{fibres} x 100": stage(*several, fast(several[0])),
    }
    for name, row in stages.items():
        print(f"{name}: a step", json.dumps(row), flush=True)
    fallen = cloud(16, 25, 1e-4) if arguments.quick else cloud(100, 100, 1e-4)
    print("a cloud:", json.dumps(fallen), flush=True)
    large = stages[f"{fibres} x 100"]
    result: dict[str, Any] = {
        "stage_s": large["stage_s"],
        "stage_error": large["stage_error"],
        "product_1e4_s": products["100 x 100"]["fast_s"],
        **{f"many_{name}": fallen[name] for name in ("error", "ratio", "wall_s")},
        "exponent": slope(rows, "evaluation_ms"),
        "product_exponent": slope(rows, "product_ms"),
        "iterations": max(row["iterations"] for row in rows.values()),
        "rows": {**rows, "many": many},
        "products": products,
        "stages": stages,
        "cloud": fallen,
    }
    if not arguments.quick:
        result["product_1e5_s"] = products["1000 x 100"]["fast_s"]
    result["memory_gib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"time of an evaluation like N^{result['exponent']:.2f}, of a product like "
        f"N^{result['product_exponent']:.2f}; most memory {result['memory_gib']:.2f} GiB"
    )
    program.end({**result, "fibres": fibres}, result)


if __name__ == "__main__":
    main()
