"""Pages of reference, made of the docstrings: one for the package, one for each module that it offers.

    python .ci/pages.py [FOLDER]

They go to `out/pages` unless said, `index.html` first, and need no network. A warning is an error.
"""

import ast
import contextlib
import importlib
import re
import sys
import warnings
from pathlib import Path
from types import ModuleType

PACKAGE = "jaxbeads"
ON_DEMAND = ["domain", "plot"]  # what is offered, but not imported by name
# Names in signatures as people write them: a dot may stand between two words of code or of text.
_DOT = r'(?:\.|</span><span class="o">\.</span><span class="n">)'
_PRIVATE = (
    rf"\b(jax|diffrax|equinox|optax)(?:{_DOT}\w+)*?{_DOT}_\w+(?:{_DOT}\w+)*?({_DOT})(?=[A-Z])"
)
_SHORTER = [
    (rf"\bjaxtyping{_DOT}", ""),
    (rf"\b(?:jax{_DOT})?jaxlib{_DOT}_jax{_DOT}(?=Array)", ""),
    (_PRIVATE, r"\1\2"),
    (
        r"<span class=\"o\">&lt;</span><span class=\"n\">module</span> <span class=\"s1\">'([\w.]+)'"
        r".*?<span class=\"o\">&gt;</span>",
        r'<span class="n">\1</span>',
    ),
]


def _imports(module: ModuleType) -> list[tuple[str | None, ast.alias]]:
    """What a file imports from where, in the order of its lines."""
    tree = ast.parse(Path(str(module.__file__)).read_text())
    lines = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return [(node.module, alias) for node in lines for alias in node.names]


def names(module: ModuleType) -> list[str]:
    """The public names of a module or a package."""
    if hasattr(module, "__all__"):
        return list(module.__all__)
    if not hasattr(module, "__path__"):
        own = [
            n for n, x in vars(module).items() if getattr(x, "__module__", "") == module.__name__
        ]
        return [n for n in own if callable(getattr(module, n)) and not n.startswith("_")]
    found: list[str] = []
    for file, alias in _imports(module):
        if alias.name == "*":
            found += names(importlib.import_module(f"{module.__name__}.{file}"))
        elif alias.name == alias.asname:  # `from .file import name as name` hands it on
            found.append(alias.name)
    return found


def modules() -> list[ModuleType]:
    """The package, then its public modules by name."""
    package = importlib.import_module(PACKAGE)
    found = [x for name in names(package) if isinstance(x := getattr(package, name), ModuleType)]
    found += [importlib.import_module(f"{PACKAGE}.{name}") for name in ON_DEMAND]
    return [package, *sorted(found, key=lambda module: module.__name__)]


def build(folder: Path) -> None:
    """Write all pages. **Raises** `Warning` for what `pdoc` warns of, as a name that is not there."""
    import pdoc

    package, *others = modules()
    shown = {module: names(module) for module in (package, *others)}
    flat = [name for name in shown[package] if not isinstance(getattr(package, name), ModuleType)]
    shown[package] = sorted(flat, key=str.lower)
    inner = [module.__name__.removeprefix(f"{PACKAGE}.") for module in others]
    for module, listed in shown.items():  # `pdoc` keeps to it, and to its order
        module.__all__ = [*inner, *listed] if module is package else listed
    pdoc.render.configure(show_source=False, footer_text=f"{PACKAGE} {package.__version__}")
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    # From a folder where nothing else is called as the package: an installed one would be doubtful.
    with warnings.catch_warnings(), contextlib.chdir(folder):
        warnings.simplefilter("error")
        others_out = rf"!{PACKAGE}\.(?!({'|'.join(inner)})$)"
        pdoc.pdoc(PACKAGE, others_out, output_directory=folder)
    for page in folder.rglob("*.html"):
        text = page.read_text()
        for pattern, shorter in _SHORTER:
            text = re.sub(pattern, shorter, text)
        page.write_text(text)


if __name__ == "__main__":
    build(Path(sys.argv[1] if len(sys.argv) > 1 else "out/pages"))
