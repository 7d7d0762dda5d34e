"""Put the figures of `results/` into the tables of the page, and single numbers into the README.

    python benchmarks/tables.py [--check]

What stands between `<!-- table NAME -->` and `<!-- end of table -->`, `<!-- value NAME -->` and
`<!-- end of value -->` is made here; the rest is written by hand. Each program has a function `tables`
that makes rows from its figures, some have `values`. Below each table stands where its figures are from.
`--check` writes nothing, and fails if a page is not what the files make of it. Either way it is a fault
if a place has no figures, figures have no place, or the page has a table outside of places.
"""

import argparse
import importlib
import json
import re
import sys
from typing import Any

from record import RESULTS, ROOT, write

PAGE, PAGES = "benchmarks/README.md", ("benchmarks/README.md", "README.md")
PLACE = re.compile(r"<!-- (table|value) (\S+) -->(.*?)<!-- end of \1 -->", re.DOTALL)


def origin(kept: dict[str, Any]) -> str:
    """Where figures come from, in a line."""
    machine = kept["machine"]
    caches = [f"{name} {size}" for name, size in machine["caches"].items()]
    on = [f"{machine['cores']} cores of {machine['processor']}", *caches, *machine["accelerators"]]
    versions = [f"{name} {version}" for name, version in kept["versions"].items()]
    return (
        f"`{kept['command']}` of {kept['commit']}, {kept['date']}; {', '.join(on)}, "
        f"{machine['system']}; {', '.join(versions)}"
    )


def texts() -> dict[tuple[str, str], str]:
    """What stands at each place, named by its kind and its name."""
    made: dict[tuple[str, str], str] = {}
    for file in sorted(RESULTS.glob("*.json")):
        kept = json.loads(file.read_text())
        program = importlib.import_module(file.stem)
        for name, rows in program.tables(kept["figures"]).items():
            lines = rows or ["This was no part of the run."]
            made["table", name] = "\n".join(["", *lines, "", f"<sub>{origin(kept)}</sub>", ""])
        if hasattr(program, "values"):
            for name, value in program.values(kept["figures"]).items():
                made["value", name] = value
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; 1 if a page differs")
    check = parser.parse_args().check
    made, placed, faults = texts(), set(), []

    def filled(place: re.Match[str]) -> str:
        kind, name, _ = key = place.groups()
        placed.add(key[:2])
        if key[:2] not in made:
            faults.append(f"{kind} {name} of the page is in no file of benchmarks/results")
            return place[0]
        return f"<!-- {kind} {name} -->{made[key[:2]]}<!-- end of {kind} -->"

    for name in PAGES:
        page = ROOT / name
        old = page.read_text()
        new = PLACE.sub(filled, old)
        if new != old and check:
            faults.append(f"{name} differs from the files: run python benchmarks/tables.py")
        elif new != old:
            write(page, new)
    by_hand = PLACE.sub("", (ROOT / PAGE).read_text())
    lines = [line for line in by_hand.splitlines() if line.startswith("|")]
    faults += [f"{PAGE} has a table that no program makes: {line}" for line in lines]
    faults += [f"{kind} {name} is on no page" for kind, name in sorted(set(made) - placed)]
    sys.exit("\n".join(faults) or None)


if __name__ == "__main__":
    main()
