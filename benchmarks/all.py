"""Run all programs of this folder one after the other, keep their figures, and fill the page with them.

    python benchmarks/all.py [--quick] [--peers] [NAME ...]

Each runs in a process of its own; nothing else should run meanwhile. One that fails leaves its old
figures, the others go on, and the exit status is 1 then. `--quick` takes the short form of each, and
leaves `peers` out, which installs packages; `accelerator` is left out where there is none. Names choose
programs.
"""

import argparse
import os
import re
import subprocess
import sys
import time

from record import ROOT

FOLDER = ROOT / "benchmarks"
PICTURE = "notebooks/figures/speed_against_error.png"  # of all scenes: not of a short run


def programs(quick: bool, peers: bool) -> list[str]:
    """Names of those that can and shall run."""
    uses = re.compile(r"^from record import .*\bProgram\b", re.MULTILINE)
    found = [p.stem for p in sorted(FOLDER.glob("*.py")) if uses.search(p.read_text())]
    # In a process of its own: this one would keep the accelerator's memory.
    asks = [sys.executable, "-c", "import jax; print(jax.default_backend())"]
    alone = subprocess.run(asks, capture_output=True, text=True).stdout.split()[-1:] == ["cpu"]
    left_out = {"accelerator": alone, "peers": quick and not peers}
    return [name for name in found if not left_out.get(name)]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the short form of each program")
    parser.add_argument("--peers", action="store_true", help="peers also with --quick")
    parser.add_argument("names", nargs="*", metavar="NAME", help="these programs alone")
    given = parser.parse_args()
    names, failed = given.names or programs(given.quick, given.peers), []
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    begun = time.perf_counter()
    for count, name in enumerate(names, 1):
        start = time.perf_counter()
        print(f"{count}/{len(names)} {name} ...", end="", flush=True)
        words = [sys.executable, f"benchmarks/{name}.py", "--save"] + ["--quick"] * given.quick
        if name == "speed_against_error" and not given.quick:
            words += ["--plot", PICTURE]
        run = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True)
        print(f" {time.perf_counter() - start:.0f} s", flush=True)
        if run.returncode:
            failed.append(name)
            print("\n".join([*run.stdout.splitlines()[-5:], *run.stderr.splitlines()[-15:]]))
    print(f"{len(names)} programs in {(time.perf_counter() - begun) / 60:.1f} minutes")
    words = [sys.executable, str(FOLDER / "tables.py")]
    if subprocess.run(words, cwd=ROOT, env=environment).returncode:
        failed.append("tables")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
