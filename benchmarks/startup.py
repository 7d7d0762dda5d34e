"""Seconds from nothing to `import jaxbeads` and to the first trajectory, each in a new process.

    python benchmarks/startup.py [--json]

The trajectory is the settling fibre (N = 34, B = 1000) for 1000 AB3 steps, compilation included.
Medians of three processes; JAX's persistent compilation cache is off.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys

IMPORT = "import time; t = time.perf_counter(); import jaxbeads; print(time.perf_counter() - t)"
FIRST = """
import time; t = time.perf_counter()
import jax; jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxbeads as jb
case = jb.scenes.settling()
step = float(jb.solver.explicit_step(case.scene))
run = jb.simulate(case.scene, case.state, np.arange(11) * 100 * step, substeps=100, progress=False)
print(time.perf_counter() - t)
"""


def seconds(program: str) -> float:
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    runs = [
        subprocess.run(
            [sys.executable, "-c", program],
            check=True,
            capture_output=True,
            text=True,
            env=environment,
        )
        for _ in range(3)
    ]
    return statistics.median(float(run.stdout) for run in runs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object as the last line"
    )
    results = {"import_s": seconds(IMPORT), "cold_s": seconds(FIRST)}
    for name, value in results.items():
        print(f"{name:<10}{value:6.2f} s")
    if parser.parse_args().json:
        print(json.dumps(results))


if __name__ == "__main__":
    main()
