"""Ready-made scenes from the shell, and drags above a wall, beside references.

    python benchmarks/ready_made.py [--quick] [--json] [--save]

Each scene is run as `python -m jaxbeads ...`, without compiled programs of earlier runs. Its references
without a source were computed with independent codes (that of the magnetic rod is a closed form);
`tests/test_scenes.py` and `tests/test_magnets.py` hold these and more. Above a no-slip wall: the drag
of a sphere of radius a that does not turn, its centre at a height h, and of a rigid rod of 10 beads
parallel to it. References are to the digits shown.
"""

import json
import shlex
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from record import Program, order, table

import jaxbeads as jb
from jaxbeads.mobility import RPY

jax.config.update("jax_enable_x64", True)

SCENES = {
    "jeffery --beads 20": {"period": "96.978"},
    "shear --beads 35 --bending-ratio 0.04 --intrinsic-curvature 0.01": {"min_radius": "0.2588"},
    "settling --beads 34 --elasto-gravitational 1000": {
        "deflection": "0.40260",
        "friction_ratio": "0.7059",
    },
    "relaxation --beads 34 --mode 1": {"rate": "108.534"},
    "cloud --fibres 8 --beads 10 --spacing 0.6": {
        "speed": "3.24564",
        "spread": "0.70082",
        "spread_lateral": "1.11903",
    },
    "shear-suspension --fibres 4 --beads 6 --spacing 0.6": {
        "curvature": "0.80456",
        "shear_stress": "0.04714",
    },
    "magnetic-rod --beads 10 --frequency 1.5": {"mean_rotation": "0.25464"},
}
QUICK = "jeffery --beads 20", "settling --beads 34 --elasto-gravitational 1000"
# Of each height over the radius: along and across the rod, towards the wall; over 6 pi mu a.
SPHERE = {
    10.07: (1.05903, 1.05903, 1.12515),
    3.762: (1.17269, 1.17269, 1.40809),
    2.352: (1.29943, 1.29943, 1.79091),
    1.543: (1.51073, 1.51073, 2.54638),
    1.128: (1.82321, 1.82321, 3.53879),
}
ROD = {
    1.5: (6.656705, 10.284737, 25.341767),
    2.0: (5.445706, 8.700811, 18.366146),
    5.0: (3.804927, 5.953593, 8.785373),
    20.0: (3.102307, 4.479311, 5.050588),
}


def run(words: str) -> dict[str, Any]:
    """What the shell prints."""
    line = [
        sys.executable,
        "-m",
        "jaxbeads",
        *shlex.split(words),
        "--json",
        "--quiet",
        "--no-cache",
    ]
    done = subprocess.run(line, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def drag(height: float, beads: int) -> tuple[float, ...]:
    """Over 6 pi mu a: along x, across it, towards the wall."""
    up = np.eye(3)[2]
    x = np.zeros((beads, 3))
    x[:, 0], x[:, 2] = 2 * np.arange(beads), height
    wall = jb.NoSlipWall(np.zeros(3), up)
    spheres = jb.Configuration(jnp.asarray(x), 1.0, 1.0, True, wall)

    def column(unit: jax.Array) -> jax.Array:
        force, torque = unit.reshape(2, beads, 3)
        moved = RPY().motion(spheres, jb.Load(force, torque))
        return jnp.concatenate([moved.velocity.ravel(), moved.spin.ravel()])

    mobility = np.asarray(jax.vmap(column, out_axes=1)(jnp.eye(6 * beads)))
    body = np.concatenate([np.tile(np.eye(3), (beads, 1)), np.zeros((3 * beads, 3))])
    return tuple(np.diag(body.T @ np.linalg.solve(mobility, body)) / (6 * np.pi))


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    scenes = []
    for words, found in figures["scenes"].items():
        for name, reference in SCENES[words].items():
            shown = f"{found[name]:.{len(reference.partition('.')[2])}f}"
            scenes.append([f"`{words}`", name, shown, reference, str(found["steps"])])
    walls = [
        [row["body"], str(row["height"]), *(f"{x:.5f}" for x in row["found"]), order(row["error"])]
        for row in figures["walls"]
    ]
    head = ("body", "h/a", "along", "across", "towards", "largest difference from references")
    return {
        "ready-made": table(
            ("`python -m jaxbeads ...`", "result", "found", "reference", "steps"), scenes
        ),
        "walls": table(head, walls),
    }


def main() -> None:
    program = Program(__doc__, "two of the scenes")
    quick = program.arguments().quick
    scenes: dict[str, dict[str, Any]] = {}
    for words in QUICK if quick else SCENES:
        found = scenes[words] = run(words)
        for name, reference in SCENES[words].items():
            print(f"{words:<68}{name:<16}{found[name]:12.6g}{reference:>12}", flush=True)
    walls = []
    for body, beads, cases in (("sphere", 1, SPHERE), ("rod of 10", 10, ROD)):
        for height, expected in cases.items():
            found = drag(height, beads)
            error = float(np.max(np.abs(np.divide(found, expected) - 1)))
            walls.append({"body": body, "height": height, "found": found, "error": error})
            cells = "".join(f"{x:12.5f}" for x in found)
            print(f"{body:<12}h/a = {height:<8}{cells}{error:10.0e}")
    program.end({"scenes": scenes, "walls": walls})


if __name__ == "__main__":
    main()
