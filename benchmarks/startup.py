"""Seconds from nothing to `import jaxbeads` and to the first trajectory, each in a new process.

    python benchmarks/startup.py [--quick] [--json]

The trajectory is the settling fibre (N = 34, B = 1000) for 1000 AB3 steps, compilation included: without
a cache of compiled programs, and with `jaxbeads.enable_cache` and a folder that an earlier process
filled. Medians of three processes (`--quick`: one).
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile

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


def seconds(program: str, rounds: int, *arguments: str) -> float:
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    runs = [
        subprocess.run(
            [sys.executable, "-c", program, *arguments],
            check=True,
            capture_output=True,
            text=True,
            env=environment,
        )
        for _ in range(rounds)
    ]
    return statistics.median(float(run.stdout) for run in runs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one process each")
    parser.add_argument("--json", action="store_true", help="one JSON object as the last line")
    arguments = parser.parse_args()
    rounds = 1 if arguments.quick else 3
    results = {"import_s": seconds(IMPORT, rounds), "cold_s": seconds(FIRST, rounds)}
    with tempfile.TemporaryDirectory() as folder:
        seconds(FIRST, 1, folder)
        results["cached_s"] = seconds(FIRST, rounds, folder)
    for name, value in results.items():
        print(f"{name:<10}{value:6.2f} s")
    if arguments.json:
        print(json.dumps(results))


if __name__ == "__main__":
    main()
