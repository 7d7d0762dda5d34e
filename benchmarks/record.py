"""What the programs here share: options, the file that each leaves in `results/`, words for tables.

A program is a file with `main`, which makes a `Program`, measures, prints and calls `end`, and with
`tables`, which makes rows of Markdown from the figures that were kept; `values` makes single numbers for
a text. `tables.py` puts both into the pages.
"""

import argparse
import datetime
import importlib.util
import json
import math
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "numpy")


class Program:
    """Options of a program, and where its figures go."""

    def __init__(self, doc: str | None, quick: str) -> None:
        self.parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
        add = self.parser.add_argument
        add("--quick", action="store_true", help=quick)
        add("--json", action="store_true", help="print one JSON object as the last line")
        add("--save", action="store_true", help="keep the figures, for the tables of the page")
        self.source: dict[str, Any] = {}

    def arguments(self) -> argparse.Namespace:
        """What was asked for. What is measured is noted now: the tree may change while it runs."""
        self.given = self.parser.parse_args()
        if self.given.save:
            if getattr(self.given, "only", None):
                self.parser.error("Option `--save` keeps whole runs: leave `--only` out.")
            found = importlib.util.find_spec("jaxbeads")
            if found is None or Path(str(found.origin)).resolve().parents[1] != ROOT:
                self.parser.error(
                    "Option `--save` keeps figures of this tree, but another `jaxbeads` is imported."
                )
            self.source = {"command": command(sys.argv), "commit": commit()}
        self.start = time.perf_counter()
        return self.given

    def end(self, figures: dict[str, Any], last: dict[str, Any] | None = None) -> None:
        """Keep the figures if that was asked for; print them, or what stands for them, as JSON."""
        if self.given.save:
            kept = {
                **self.source,
                "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
                "seconds": round(time.perf_counter() - self.start),
                "machine": machine(),
                "versions": {"Python": platform.python_version()}
                | {name: version(name) for name in PACKAGES},
                "figures": figures,
            }
            write(RESULTS / f"{Path(sys.argv[0]).stem}.json", json.dumps(kept, indent=1) + "\n")
        if self.given.json:
            print(json.dumps(figures if last is None else last))


def command(words: Sequence[str]) -> str:
    """The command line without what names a folder of this machine."""
    kept = [w for w in words[1:] if w not in ("--save", "--json")]
    flags = os.environ.get("XLA_FLAGS")
    before = [] if flags is None else [f"XLA_FLAGS={flags!r}"]
    line = [*before, "python", f"benchmarks/{Path(words[0]).name}", *kept]
    return " ".join(re.sub(r"(?<![^=\"'])/\S*/", "", word) for word in line)


def commit() -> str:
    """What JAXBEADS_COMMIT says, as where a tree is copied without its history; or else `git describe`,
    `-dirty` if code differs.
    """
    if told := os.environ.get("JAXBEADS_COMMIT"):
        return told

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(ROOT), *words], check=True, capture_output=True, text=True
        ).stdout.strip()

    try:
        name = git("describe", "--always", "--tags")
        code = ("jaxbeads/**/*.py", "benchmarks/*.py")
        changed = git("status", "--porcelain", "--", *(f":(glob){path}" for path in code))
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return name + "-dirty" * bool(changed)


def machine() -> dict[str, Any]:
    """Processor, cores that this process may use, caches, memory, accelerators; no names."""
    import jax

    cpu = Path("/proc/cpuinfo")
    model = re.search(r"^model name\s*: (.*)$", cpu.read_text(), re.M) if cpu.exists() else None
    caches = {}
    for index in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        level, size = ((index / part).read_text().strip() for part in ("level", "size"))
        if int(level) > 1:
            caches[f"L{level}"] = size
    affinity = getattr(os, "sched_getaffinity", None)
    found: dict[str, Any] = {
        "system": platform.system(),
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "cores": len(affinity(0)) if affinity else os.cpu_count(),
        "caches": caches,
    }
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        found["memory_gib"] = round(memory / 2**30, 1)
    kinds = [d.device_kind for d in jax.devices() if d.platform != "cpu"]
    return found | {"accelerators": sorted(set(kinds))}


def write(path: Path, text: str) -> None:
    """In one piece: who reads sees the old file or the new one."""
    path.parent.mkdir(exist_ok=True)
    with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".part", delete=False) as file:
        part = Path(file.name)
        try:
            file.write(text)
            file.close()
            part.chmod(0o644)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Lines of a table of Markdown; none without rows."""
    lines = [list(head), *map(list, rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return ["| " + " | ".join(line) + " |" for line in lines] if len(lines) > 2 else []


def number(value: float | None, digits: int = 2) -> str:
    """With some digits, and thousands apart."""
    if value is None:
        return "-"
    rounded = float(f"{value:.{digits}g}")
    if not 1e-3 <= abs(rounded) < 1e7:
        return f"{rounded:.{digits}g}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(rounded))))
    return f"{rounded:,.{decimals}f}".replace(",", " ")


def order(value: float | None) -> str:
    """An error, with one digit."""
    if value is None or not 0 < value < 0.1:
        return number(value, 1)
    return f"{value:.0e}".replace("e-0", "e-")


def duration(seconds: float | None, digits: int = 2) -> str:
    """In a unit that fits."""
    if seconds is None:
        return "-"
    units = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
    unit = next((unit for unit, size in units.items() if seconds >= 0.9995 * size), "us")
    return f"{number(seconds / units[unit], digits)} {unit}"
