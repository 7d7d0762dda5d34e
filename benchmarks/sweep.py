"""Throughput of a sweep on one device, on two, and in two processes.

    python benchmarks/sweep.py [--quick] [--json] [--save]

Settling Gears fibres (N = 20) of different stiffness take the same number of AB3 steps each. Every row
is a sweep of its own in new processes; on a CPU a device is a share of its cores. Members per second
are counted from the times at which chunks are written, from the first to the last, so that starting and
compiling are left out. `bitwise` says whether the table is that of one device, to the last bit.
"""

import argparse
import hashlib
import os
import socket
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from record import Program, number, table

CHUNK = 16


def worker(devices: int, folder: str, steps: int, members: int, meeting: str, number: int) -> None:
    """One process of a sweep."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", devices)
    if meeting:
        jax.distributed.initialize(meeting, 2, number)
    import jax.numpy as jnp
    import numpy as np

    import jaxbeads as jb
    from jaxbeads.constraint import Gears
    from jaxbeads.force import Bending, Weight

    chain = jb.Chain(1.0, 20)
    state = jb.straight(chain, [1.0, 0.0])
    step = 0.5 * 2.0**4 / 1600

    def build(rigidity: jax.Array) -> tuple[jb.Scene, jb.State]:
        forces = [Weight(jnp.array([0.0, -1.0])), Bending(rigidity)]
        return jb.Scene(chain, 1.0, constraints=[Gears()], forces=forces), state

    def measure(run: jb.Solution, scene: jb.Scene) -> dict[str, jax.Array]:
        return {"position": run.final.position}

    axes = {"rigidity": np.linspace(800, 1600, members)}
    ts = np.array([0.0, step * steps])
    table = jb.sweep(
        build, axes, ts, measure, substeps=steps, chunk=CHUNK, folder=folder, progress=False
    )
    assert not table.code.any()
    print(hashlib.sha256(table.position.values.tobytes()).hexdigest())


def run(devices: int, processes: int, steps: int, members: int) -> tuple[float, str]:
    """Members per second, and a digest of the table."""
    with tempfile.TemporaryDirectory() as folder, socket.socket() as free:
        meeting = ""
        if processes > 1:
            free.bind(("127.0.0.1", 0))
            meeting = f"127.0.0.1:{free.getsockname()[1]}"
            free.close()
        given = devices, folder, steps, members
        started = [
            subprocess.Popen(
                [sys.executable, __file__, "--worker", *map(str, given), meeting, str(number)],
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | {"JAX_PLATFORMS": "cpu"},
            )
            for number in range(processes)
        ]
        texts = [process.communicate()[0] for process in started]
        assert not any(process.returncode for process in started)
        written = sorted(path.stat().st_mtime for path in Path(folder).glob("chunk_*.npz"))
        # Chunks of the first turn end together: they mark the start.
        turn = devices * processes
        rate = CHUNK * (len(written) - turn) / (written[-1] - written[turn - 1])
        return rate, texts[0].splitlines()[-1]


def tables(figures: dict[str, Any]) -> dict[str, list[str]]:
    head = (f"{figures['members']} members", "members per second", "ratio", "same bits")
    rows = (
        [
            name,
            number(row["per_second"], 3),
            number(row["ratio"], 3),
            ["no", "yes"][row["bitwise"]],
        ]
        for name, row in figures["rows"].items()
    )
    return {"devices": table(head, rows)}


def main() -> None:
    program = Program(__doc__, "fewer members and rounds")
    program.parser.add_argument("--worker", nargs=6, help=argparse.SUPPRESS)
    arguments = program.arguments()
    if arguments.worker:
        devices, folder, steps, members, meeting, number = arguments.worker
        worker(int(devices), folder, int(steps), int(members), meeting, int(number))
        return
    rounds, members, steps = (1, 16 * CHUNK, 2000) if arguments.quick else (3, 32 * CHUNK, 4000)
    layouts = {"1 device": (1, 1), "2 devices": (2, 1), "2 processes": (1, 2)}
    rates: dict[str, list[float]] = {name: [] for name in layouts}
    bits: dict[str, str] = {}
    for _ in range(rounds):
        for name, layout in layouts.items():
            rate, bits[name] = run(*layout, steps, members)
            rates[name].append(rate)
    one = statistics.median(rates["1 device"])
    print(f"{'':14}{'members/s':>12}{'ratio':>8}  bitwise")
    rows: dict[str, dict[str, Any]] = {}
    for name in layouts:
        rate, same = statistics.median(rates[name]), bits[name] == bits["1 device"]
        rows[name] = row = {"per_second": rate, "ratio": rate / one, "bitwise": same}
        print(f"{name:14}{rate:12.1f}{row['ratio']:8.2f}  {same}")
    result = {
        "throughput_ratio": rows["2 devices"]["ratio"],
        "processes_ratio": rows["2 processes"]["ratio"],
        "bitwise": len(set(bits.values())) == 1,
    }
    program.end({"members": members, "steps": steps, "rows": rows}, result)


if __name__ == "__main__":
    main()
