"""Time of one velocity evaluation against LAPACK's Cholesky factor + solve of the same matrix.

    python benchmarks/step_cost.py [--quick] [--json] [--save]

The scene is a settling Gears fibre (weight, bending, RPY with rotation), slightly bent, in an unbounded
fluid; `wall`: the same fibre, its lowest bead 1.5 a above a no-slip wall, and `over_free` its time over
that without a wall, measured in turns (median of the ratios). A velocity evaluation is everything that
a time step needs once: mobility, loads, S = J M J^T, multipliers, velocities. It is timed inside a
compiled loop, as in a run. The floor is `dpotrf` + `dpotrs` through SciPy on the very S of that
configuration: no method that factorises S can be faster. Both are measured in turns, in one run; medians
are reported. The error is that of the velocities against a dense elimination of the saddle-point system
in NumPy; memory is what the compiled evaluation needs beside its arguments.

`rod`: the fibre in space as an elastic rod with twist and material frames. `bacterium`: a head and a
helix with a motor (the scene of that name), whose floor is that of M.
"""

import statistics
import time
from functools import partial
from operator import truediv
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg.lapack as lapack
from jax import lax
from record import Program, duration, number, order, table

import jaxbeads as jb
from jaxbeads import dynamics, scenes
from jaxbeads.constraint import Gears
from jaxbeads.force import Bending, ElasticRod, Weight

jax.config.update("jax_enable_x64", True)


def fibre(beads: int, dim: int, wall: bool = False, rod: bool = False) -> tuple[jb.Scene, jb.State]:
    """A settling fibre bent to an S of about half a radian, over a wall or without one, or a rod."""
    chain = jb.Chain(1.0, beads)
    angle = 0.5 * np.sin(2 * np.pi * np.linspace(0, 1, beads - 1))
    tangents = np.stack([np.cos(angle), np.sin(angle), 0.3 * np.cos(2 * angle)], axis=1)[:, :dim]
    state = jb.State(jb.from_tangents(chain, tangents))
    up = np.eye(dim)[1]
    ground = (jnp.min(state.position[:, 1]) - 1.5) * up
    elastic = ElasticRod(float(beads), float(beads)) if rod else Bending(float(beads))
    state = jb.with_frames(state, chain, twist=0.01) if rod else state
    scene = jb.Scene(
        chain,
        1.0,
        constraints=[Gears()],
        forces=[Weight(-up), elastic],
        domain=jb.NoSlipWall(ground, up) if wall else jb.Unbounded(),
    )
    return scene, state


def dense_velocity(scene: jb.Scene, state: jb.State) -> np.ndarray:
    """Reference: the saddle-point system (M, J) as full matrices, in NumPy."""
    beads, dim = state.position.shape
    turns = 1 if dim == 2 else 3
    t = jnp.zeros(())

    def pack(motion: jb.Motion) -> jax.Array:
        return jnp.concatenate([x.ravel() for x in jax.tree.leaves(motion)])

    def unpack(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        return x[: beads * dim].reshape(beads, dim), x[beads * dim :].reshape(beads, turns)

    operator = scene.operator(state).kept()
    size = beads * (dim + turns)
    mobility = np.asarray(
        jax.vmap(lambda u: pack(operator.motion(jb.Load(*unpack(u)))))(jnp.eye(size))
    )
    (constraint,) = scene.constraints
    jacobian = np.asarray(
        jax.jacfwd(lambda x: constraint.slip(t, state, jb.Motion(*unpack(x)), scene.chain).ravel())(
            jnp.zeros(size)
        )
    )
    load = dynamics.applied_load(t, state, scene)
    force = np.concatenate([np.ravel(load.force), np.ravel(load.torque)])
    free = mobility.T @ force
    multipliers = np.linalg.solve(jacobian @ mobility @ jacobian.T, -jacobian @ free)
    return (free + mobility @ jacobian.T @ multipliers)[: beads * dim].reshape(beads, dim)


def seconds(function, *arguments) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


@partial(jax.jit, static_argnums=2)
def evaluations(state: jb.State, scene: jb.Scene, loops: int) -> jb.State:
    def body(_: int, state: jb.State) -> jb.State:
        velocity = dynamics.motion(0.0, state, scene).velocity
        return eqx.tree_at(lambda s: s.position, state, state.position + 1e-12 * velocity)

    return lax.fori_loop(0, loops, body, state)


def measure(
    beads: int, dim: int, rounds: int, wall: bool = False, rod: bool = False
) -> dict[str, float]:
    scene, state = fibre(beads, dim, wall, rod)
    free, _ = fibre(beads, dim)
    loops = max(3, int(4e5 / beads**2))
    single = jax.jit(lambda state, scene: dynamics.motion(0.0, state, scene).velocity)
    start = time.perf_counter()
    compiled = single.lower(state, scene).compile()
    compile_s = time.perf_counter() - start
    matrix = np.asfortranarray(dynamics.constraint_matrix(0.0, state, scene))
    right = np.random.default_rng(0).normal(size=len(matrix))

    def floor() -> None:
        for _ in range(loops):
            factor, _ = lapack.dpotrf(matrix, lower=1, clean=0)
            lapack.dpotrs(factor, right, lower=1)

    evaluations(state, scene, loops), evaluations(state, free, loops), floor()  # warm
    ours, theirs, frees = [], [], []
    for _ in range(rounds):
        theirs.append(seconds(floor) / loops)
        ours.append(seconds(evaluations, state, scene, loops) / loops)
        if wall:
            frees.append(seconds(evaluations, state, free, loops) / loops)
    reference = dense_velocity(scene, state)
    error = np.abs(single(state, scene) - reference).max() / np.abs(reference).max()
    memory = compiled.memory_analysis().temp_size_in_bytes
    evaluation, lowest = statistics.median(ours), statistics.median(theirs)
    return {
        "evaluation_us": 1e6 * evaluation,
        "floor_us": 1e6 * lowest,
        "ratio": evaluation / lowest,
        "error": float(error),
        "memory_mib": memory / 2**20,
        "compile_s": compile_s,
    } | ({"over_free": statistics.median(map(truediv, ours, frees))} if wall else {})


@partial(jax.jit, static_argnums=2)
def instants(pose: jb.Pose, assembly: jb.Assembly, loops: int) -> jb.Pose:
    def body(_: int, pose: jb.Pose) -> jb.Pose:
        rate = jb.locomotion.rate(0.0, pose, assembly)
        return jax.tree.map(lambda x, v: x + 1e-12 * v, pose, rate)

    return lax.fori_loop(0, loops, body, pose)


def measure_bodies(rounds: int) -> dict[str, float]:
    """Of a bacterium."""
    case = scenes.bacterium()
    assembly, pose, loops = case.assembly, case.pose, 300
    start = time.perf_counter()
    compiled = jax.jit(jb.locomotion.rate).lower(0.0, pose, assembly).compile()
    compile_s = time.perf_counter() - start
    scene, state = case.scene, case.state
    beads, frames = assembly.beads, assembly.frames(pose)
    configuration = scene.configuration(state, True)
    matrix = np.asarray(assembly.mobility.tables(configuration).matrix())
    arm = state.position - frames.origin[assembly.body_of_bead]

    def moved(unknown: jax.Array) -> jax.Array:
        twists = assembly.twists(jnp.zeros(()), pose, frames, unknown)
        velocity, spin = (x[assembly.body_of_bead] for x in twists)
        return jnp.concatenate([(velocity + jnp.cross(spin, arm)).T.ravel(), spin.T.ravel()])

    none = jnp.zeros(assembly.unknowns)
    carried, given = np.asarray(jax.jacfwd(moved)(none)), np.asarray(moved(none))
    held = np.linalg.solve(matrix, np.column_stack([carried, given]))
    expected = np.linalg.solve(carried.T @ held[:, :-1], -carried.T @ held[:, -1])[:3]
    found = np.asarray(compiled(0.0, pose, assembly).place[0])
    right, whole = np.ones(6 * beads), np.asfortranarray(matrix)

    def floor() -> None:
        for _ in range(loops):
            factor, _ = lapack.dpotrf(whole, lower=1, clean=0)
            lapack.dpotrs(factor, right, lower=1)

    instants(pose, assembly, loops), floor()  # warm
    ours, theirs = [], []
    for _ in range(rounds):
        theirs.append(seconds(floor) / loops)
        ours.append(seconds(instants, pose, assembly, loops) / loops)
    evaluation, lowest = statistics.median(ours), statistics.median(theirs)
    return {
        "evaluation_us": 1e6 * evaluation,
        "floor_us": 1e6 * lowest,
        "ratio": evaluation / lowest,
        "error": float(np.abs(found - expected).max() / np.abs(expected).max()),
        "memory_mib": compiled.memory_analysis().temp_size_in_bytes / 2**20,
        "compile_s": compile_s,
    }


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    def cells(name: str, row: dict[str, float], against: str) -> list[str]:
        return [
            name.replace("-wall", "").replace("-", ", N = "),
            duration(1e-6 * row["evaluation_us"]),
            number(row[against]),
            order(row["error"]),
            f"{number(row['memory_mib'])} MiB",
            duration(row["compile_s"]),
        ]

    free = {name: row for name, row in figures.items() if "over_free" not in row}
    walls = {name: row for name, row in figures.items() if "over_free" in row}
    rest = ("error", "memory", "compiling")
    return {
        "evaluation": table(
            ("", "evaluation", "over LAPACK", *rest),
            (cells(n, r, "ratio") for n, r in free.items()),
        ),
        "evaluation-wall": table(
            ("", "evaluation", "over that without a wall", *rest),
            (cells(n, r, "over_free") for n, r in walls.items()),
        ),
    }


def main() -> None:
    program = Program(__doc__, "N = 34 and 100 only, fewer rounds")
    arguments = program.arguments()
    sizes, rounds = ((34, 100), 11) if arguments.quick else ((15, 34, 100, 300), 21)
    cases = [
        (f"{kind}-{beads}{'-wall' * wall}", dim, beads, wall)
        for wall in (False, True)
        for dim, kind in ((2, "planar"), (3, "spatial"))
        for beads in (sizes if not wall else (34, 100))
    ]
    columns = (
        "evaluation_us",
        "floor_us",
        "ratio",
        "error",
        "memory_mib",
        "compile_s",
        "over_free",
    )
    print(f"{'scene':<18}" + "".join(f"{c:>16}" for c in columns))
    results = {}
    measured = {
        name: partial(measure, beads, dim, rounds, wall) for name, dim, beads, wall in cases
    }
    measured["rod-34"] = partial(measure, 34, 3, rounds, rod=True)
    measured["bacterium-36"] = partial(measure_bodies, rounds)
    for name, one in measured.items():
        row = results[name] = one()
        found = "".join(f"{row[c]:16.3g}" if c in row else "" for c in columns)
        print(f"{name:<18}{found}", flush=True)
    program.end(results)


if __name__ == "__main__":
    main()
