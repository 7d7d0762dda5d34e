"""The package's own rules: one way of imports, no plotting on import, no global configuration."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxbeads

PACKAGE = Path(jaxbeads.__file__).parent

# A module imports from earlier rows only (and, in a row, what `base` modules allow).
ORDER = [
    {"plain"},
    {"_compat"},
    {"_typing", "_checks", "loops", "programs", "outcome"},
    {"_functions", "domain"},
    {"factors", "units", "optimum"},
    {"iterations", "rodas"},
    {"storage"},
    {"vary", "optimise", "chunks", "cache", "contents", "shares"},
    {"state", "geometry"},
    {"pairs", "quaternions"},
    {"coefficients", "configuration", "neighbours"},
    {"tensors"},
    {"products"},
    {"segments"},
    {"reflection"},
    {"images", "mirror"},
    {"fields"},
    {"chain", "flow", "actuation", "dimensionless", "magnetism"},
    {"material", "setting", "tables", "body"},
    {"carried"},
    {"mobility", "constraint", "force", "coincidence"},
    {"scene"},
    {"windows", "assembly"},
    {"coordinates", "saddle", "locomotion", "touching"},
    {"instant"},
    {"dynamics"},
    {"loads", "lengthwise"},
    {"near"},
    {"linearise", "stages", "observables", "stress", "faults"},
    {"solver", "steady"},
    {"solution"},
    {"rollout", "travel"},
    {"breakdown", "files", "objectives", "periodic", "progress"},
    {"run", "fluid"},
    {"simulate"},
    {"scenes", "plot", "sweep", "paraview"},
    {"__main__"},
]
# What the files of a sub-package may import from one another.
SHARED = {
    "body": {"base", "joints"},
    "solver": {"base", "watch", "tolerance"},
    "constraint": {"base", "prescribed"},
    "force": {"base", "curvature"},
    "scenes": {"case", "models"},
    "plot": {"base", "space"},
}
RANK = {name: rank for rank, row in enumerate(ORDER) for name in row}


def modules():
    return sorted(p for p in PACKAGE.rglob("*.py") if p.name != "__init__.py")


def imported(path):
    """Names of the package's modules that a file imports, as (sub-package or module, file)."""
    inside = path.relative_to(PACKAGE).parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = inside[: len(inside) - node.level]
            names = [node.module] if node.module else [alias.name for alias in node.names]
            for name in names:
                yield (*base, *name.split("."))


@pytest.mark.parametrize("path", modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    parts = (*path.relative_to(PACKAGE).parts[:-1], path.stem)
    for target in imported(path):
        if target[0] == parts[0] and len(parts) > 1:  # within a sub-package
            shared = SHARED.get(parts[0], {"base"})
            assert target[1] in shared, f"{parts} imports its sibling {target}"
        else:
            assert RANK[target[0]] < RANK[parts[0]], f"{parts} imports {target}"


def test_every_module_has_a_place():
    names = {p.relative_to(PACKAGE).parts[0].removesuffix(".py") for p in modules()}
    assert names == set(RANK)


def test_files_do_one_job():
    lengths = {str(p): len(p.read_text().splitlines()) for p in modules()}
    assert max(lengths.values()) <= 400, lengths
    source = "\n".join(p.read_text() for p in modules())
    assert "from __future__ import annotations" not in source
    tree = [n for p in modules() for n in ast.walk(ast.parse(p.read_text()))]
    assert not any(isinstance(n, ast.Assert) for n in tree)


def test_import_loads_no_plotting_and_changes_no_configuration():
    program = (
        "import sys, jax; before = dict(jax.config.values); import jaxbeads; "
        "assert dict(jax.config.values) == before, 'configuration changed'; "
        "assert 'matplotlib' not in sys.modules, 'matplotlib imported'; "
        # Nothing is computed yet: devices, processes and precision can still be chosen.
        "jax.config.update('jax_num_cpu_devices', 2); assert len(jax.devices()) == 2; "
        "jax.config.update('jax_enable_x64', True); from jaxbeads import scenes; "
        "assert scenes.settling(4, 10.0, scenes.JOINT).scene.chain.gap == 0.1"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
