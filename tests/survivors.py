"""Results of all that rests on `jaxbeads._compat`, small: for processes in which some of it is gone.

`python survivors.py PARTS FOLDER NAME ...` takes the things NAME away while `jaxbeads` is imported, and
puts them back for the dependencies, which need them themselves. `NAME=wrong` makes it a function that
answers with a word. The results are printed as JSON.
"""

import importlib
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np


def model():
    import jaxbeads as jb

    chain = jb.Chain(1.0, 3)
    state = jb.State(jb.from_tangents(chain, [[1.0, 0.0], [0.8, 0.6]]))

    def scene(rigidity):
        forces = [jb.force.Bending(rigidity), jb.force.Weight([0.0, -1.0])]
        return jb.Scene(chain, 1.0, constraints=[jb.constraint.Gears()], forces=forces)

    return scene, state


def fixed(folder):
    """Equal steps, alone and side by side, with derivatives."""
    import jaxbeads as jb

    scene, state = model()

    def height(rigidity):
        run = jb.rollout(scene(rigidity), state, [0.0, 1.0], substeps=2)
        return jnp.sum(run.final.position**2)

    both = jax.value_and_grad(height)
    return jax.jit(both)(30.0), jax.jit(jax.vmap(both))(jnp.array([20.0, 30.0, 40.0]))


def adaptive(folder):
    """Steps by a tolerance, implicit ones."""
    import jaxbeads as jb

    scene, state = model()
    run = jb.rollout(scene(30.0), state, [0.0, 8.0])
    return run.final.position, run.steps


def factors(folder):
    """Solutions by factors, of one matrix and of many."""
    from jaxbeads.factors import cholesky, cholesky_solve, inverse_of_triangle, lu, triangular_solve

    a = np.random.default_rng(0).normal(size=(3, 5, 5))
    s, rhs = a @ a.swapaxes(1, 2) + np.eye(5), np.arange(15.0).reshape(3, 5)

    def solved(a, s, rhs):
        factor, order = lu(a)
        half = triangular_solve(factor, rhs[order], lower=True, unit=True)
        back = triangular_solve(factor, rhs, lower=False, transposed=True)
        lower, positive = cholesky(jnp.triu(s))
        rest = jnp.tril(inverse_of_triangle(jnp.tril(lower)))
        x = triangular_solve(factor, half, lower=False)
        return x, back, cholesky_solve(lower, rhs), rest, positive, cholesky(-s)[1]

    alone = jax.jit(solved)(a[0], s[0], rhs[0])
    empty = cholesky(jnp.zeros((0, 0)))[1]
    return alone, jax.jit(jax.vmap(solved))(a, s, rhs), empty


def sweeps(folder):
    """A sweep over all devices, in chunks."""
    import jaxbeads as jb

    scene, state = model()

    def measure(solution, scene):
        return {"height": solution.final.position[:, 1]}

    table = jb.sweep(
        lambda rigidity: (scene(rigidity), state),
        {"rigidity": [10.0, 20.0, 30.0, 40.0, 50.0]},
        [0.0, 1.0],
        measure,
        substeps=2,
        chunk=2,
        progress=False,
    )
    return table.height.values, table.code.values


def watched(folder):
    """A run for people, its programs kept on disk; whether the time for compiling is known."""
    import jaxbeads as jb

    jb.enable_cache(Path(folder) / "programs")
    scene, state = model()
    run = jb.simulate(scene(30.0), state, [0.0, 1.0], substeps=2, progress=False)
    with_numbers = jb.simulate(scene(30.0), state, [0.0, 1.0], substeps=2, progress=False)
    jax.tree.map(jnp.subtract, run.states, with_numbers.states)
    return run.states.position, run.compile_s > 0, np.isnan(run.compile_s)


PARTS = {f.__name__: f for f in (fixed, adaptive, factors, sweeps, watched)}


def results(names, folder):
    """Flat lists of numbers by name of the part."""
    found = {name: jax.tree.leaves(PARTS[name](folder)) for name in names}
    return {n: [np.asarray(x, float).ravel().tolist() for x in f] for n, f in found.items()}


def taken_away(names):
    """Take things away; what puts them back."""
    gone = []
    for name in names:
        module, _, word = name.partition("=")[0].rpartition(".")
        place = importlib.import_module(module)
        gone.append((place, word, getattr(place, word)))
        if name.endswith("=wrong"):
            setattr(place, word, lambda *_, **__: "nothing_that_exists")
        else:
            delattr(place, word)
    return lambda: [setattr(*one) for one in gone]


if __name__ == "__main__":
    for name in ("diffrax", "optax", "xarray"):  # while all is there
        importlib.import_module(name)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 2)
    back = taken_away(sys.argv[3:])
    importlib.import_module("jaxbeads")
    back()
    print(json.dumps(results(sys.argv[1].split(","), sys.argv[2])))
