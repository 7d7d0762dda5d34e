"""What `peers.py` runs in the environment of another package: one request in, one JSON object out.

    python benchmarks/peers_worker.py pygrpy|softmobility < request.json

Needs jax and that package, not jaxbeads. The request and the result are described at each function.
"""

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: see `peers.py`

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_enable_compilation_cache", False)


def median_seconds(function: Callable[[], Any], calls: int) -> float:
    """Median time of a call, after one that is not counted."""
    jax.block_until_ready(function())
    times = []
    for _ in range(calls):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], float]:
    """The function compiled for these arguments, and the seconds for that, with tracing."""
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - start


def pygrpy(request: dict[str, Any]) -> dict[str, Any]:
    """Grand mobility matrix times one vector, by both modules.

    Request: `position` (N, 3), `radius`, `load` (forces of all, then torques of all) and `calls`.
    """
    from pygrpy import grpy_tensors, jax_grpy_tensors

    position, load = np.array(request["position"]), np.array(request["load"])
    radii = np.full(len(position), request["radius"])

    def plain() -> np.ndarray:
        return grpy_tensors.mu(position, radii) @ load

    def product(position: jax.Array, radii: jax.Array, load: jax.Array) -> jax.Array:
        return jax_grpy_tensors.mu(position, radii) @ load

    arguments = jnp.asarray(position), jnp.asarray(radii), jnp.asarray(load)
    fast, compile_s = compiled(product, *arguments)
    return {
        "numpy_s": median_seconds(plain, request["calls"]),
        "jax_s": median_seconds(lambda: fast(*arguments), request["calls"]),
        "compile_s": compile_s,
        "motions": [plain().tolist(), fast(*arguments).tolist()],
    }


def softmobility(request: dict[str, Any]) -> dict[str, Any]:
    """A straight fibre that settles from an inclined start, by the default scheme of the package.

    Request: `beads`, `radius`, `weight`, `rigidity`, `angle` below the horizontal, `planar`, `step`,
    and `calls` of `steps` each that go on from one another: the path is as long as all of them.
    """
    import softmobility as sm

    start = time.perf_counter()
    fibre = sm.FlexibleFiber(
        n_beads=request["beads"],
        radius=request["radius"],
        bending_rigidity=request["rigidity"],
        mass=request["weight"],
        planar=request["planar"],
    )
    gravity = sm.gravity_field(g=1.0)
    solver = sm.FlowBodyRollout(fibre, sm.no_flow(), input_map={"gravity": gravity})
    build_s = time.perf_counter() - start
    design = jnp.asarray(fibre.design_defaults, float)

    def piece(origin: jax.Array, turn: jax.Array, angles: jax.Array, design: jax.Array) -> Any:
        path = solver.rollout(
            dt=request["step"],
            n_steps=request["steps"],
            init_position=origin,
            init_orientation=turn,
            init_dofs=angles,
            design=design,
        )
        return [x[-1] for x in path]

    @jax.jit
    def beads(origin: jax.Array, turn: jax.Array, angles: jax.Array) -> jax.Array:
        local = [sphere.position(angles, design, jnp.zeros(1)) for sphere in fibre.spheres]
        return origin + jnp.stack(local) @ sm.rotation_matrix(turn).T

    angles = jnp.asarray(fibre.dof_defaults, float)
    state = [jnp.zeros(3), jnp.array([0.0, request["angle"], 0.0]), angles]
    program, compile_s = compiled(piece, *state, design)
    jax.block_until_ready(program(*state, design))  # warm
    positions, times = [beads(*state).tolist()], []
    for _ in range(request["calls"]):
        begun = time.perf_counter()
        state = jax.block_until_ready(program(*state, design))
        times.append(time.perf_counter() - begun)
        positions.append(beads(*state).tolist())
    return {
        "step_s": statistics.median(times) / request["steps"],
        "build_s": build_s,
        "compile_s": compile_s,
        "position": positions,
        "slip": contact_slip(fibre, angles, design, request["radius"]),
    }


def contact_slip(fibre: Any, angles: jax.Array, design: jax.Array, radius: float) -> float:
    """Largest slip where neighbours touch, of a straight fibre, over the surface speed of the bead that
    is turned: columns of the package's Jacobian, one for each angle."""
    jacobian = np.asarray(fibre.compute_Jacobian_matrix(angles, design, jnp.zeros(1))[0])
    velocity, spin = np.split(jacobian[:, 6:].reshape(fibre.Nspheres, 6, -1), 2, axis=1)
    surface = radius * np.cross(spin, np.array([1.0, 0.0, 0.0]), axisa=1, axisc=1)
    slip = velocity[:-1] + surface[:-1] - velocity[1:] + surface[1:]
    return float(np.abs(slip).max() / radius)


if __name__ == "__main__":
    work = {"pygrpy": pygrpy, "softmobility": softmobility}[sys.argv[1]]
    print(json.dumps(work(json.load(sys.stdin))))
