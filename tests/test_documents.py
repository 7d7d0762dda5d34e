"""What people read: lengths, links, pictures, recipes, and that what is named is there."""

import json
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import jupytext
import pytest

import jaxbeads
from jaxbeads.scenes import SCENES

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
PAGES = [ROOT / "README.md", ROOT / "jaxbeads" / "README.md", ROOT / "benchmarks" / "README.md"]
README = PAGES[0].read_text()
RECIPE = re.compile(r"^#+ How do I .*\?$", re.MULTILINE)


def prose(path):
    """The text of a page, or of a notebook's markdown, without blocks of code."""
    text = path.read_text()
    if path.suffix == ".py":
        cells = jupytext.reads(text, fmt="py:percent").cells
        text = "\n\n".join(c.source for c in cells if c.cell_type == "markdown")
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(path):
    """Names of a page's headings, as links have them."""
    titles = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def links(path):
    """Where the links and pictures of a page lead, within the tree."""
    text = re.sub(r"`[^`\n]*`", "", prose(path))
    found = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    return [link for link in found if not re.match(r"[a-z]+:", link)]


def test_readme_is_a_guide():
    assert len(README.splitlines()) <= 200
    commands = re.search(r"<!-- setup -->(.*)<!-- end of setup -->", README, re.DOTALL)
    assert len(re.findall(r"^python ", commands[1], re.MULTILINE)) == 2  # which `.ci/run` runs


@pytest.mark.parametrize("path", PAGES + NOTEBOOKS, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    for link in links(path):
        name, _, anchor = link.partition("#")
        target = path.parent / name if name else path
        assert target.exists(), f"{link} leads nowhere"
        assert not anchor or anchor in anchors(target), f"{link} has no such heading"


@pytest.mark.parametrize("path", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_that_are_named_are_there(path):
    named = re.findall(r"\b(?:tests|notebooks|benchmarks|\.ci)/[\w/]+\.\w+", path.read_text())
    missing = {name for name in named if "NAME" not in name and not (ROOT / name).exists()}
    assert not missing


def test_table_of_new_things_names_what_is_there():
    page = PAGES[1].read_text()
    table = "\n".join(line for line in page.splitlines() if line.startswith("|"))
    source = {p: p.read_text() for p in [*ROOT.glob("jaxbeads/**/*.py"), *ROOT.glob("tests/*.py")]}
    every = "\n".join(source.values())
    for name in re.findall(r"`(Abstract\w+)`", table):
        assert f"class {name}(" in every, name
    for name in re.findall(r"`([A-Z_]{4,})`", table):
        assert re.search(rf"^{name}(: [^=]*)? = ", every, re.MULTILINE), name
    for name in re.findall(r"`([a-z_]+)`", table):
        assert re.search(rf"\b{name}\b", every), name
    for name in re.findall(r"`([\w/]+(?:\.py|/))`", table):
        places = [
            folder / name for folder in (ROOT, ROOT / "jaxbeads", ROOT / "jaxbeads" / "force")
        ]
        assert "NAME" in name or any(place.exists() for place in places), name


def test_pictures_are_small_and_shown():
    shown = {(p.parent / link).resolve() for p in PAGES + NOTEBOOKS for link in links(p)}
    for picture in (ROOT / "notebooks" / "figures").iterdir():
        assert picture.stat().st_size <= 60_000, picture.name
        assert picture.resolve() in shown, f"{picture.name} is shown nowhere"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_every_notebook_has_a_picture_and_a_sentence(path):
    rows = [line for line in README.splitlines() if f"(notebooks/{path.stem}.ipynb)" in line]
    assert any(f'src="notebooks/figures/{path.stem}.png"' in row for row in rows)


def test_every_scene_is_in_the_table():
    listed = re.findall(r"^\| `([\w-]+)` \|", README, re.MULTILINE)
    assert sorted(listed) == sorted(ready.name for ready in SCENES)


def test_every_benchmark_has_its_command():
    page = PAGES[2].read_text()
    programs = [p for p in (ROOT / "benchmarks").glob("*.py") if "__main__" in p.read_text()]
    programs = [p for p in programs if not p.stem.endswith("_worker")]
    assert len(programs) >= 9
    assert not [p.name for p in programs if f"python benchmarks/{p.name}" not in page]


def test_tables_are_those_of_the_files():
    # In a process of its own: programs choose devices and precision.
    command = [sys.executable, ROOT / "benchmarks" / "tables.py", "--check"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_figures_say_where_they_are_from():
    files = sorted((ROOT / "benchmarks" / "results").iterdir())
    assert files
    for file in files:
        kept = json.loads(file.read_text())
        assert f"python benchmarks/{file.stem}.py" in kept["command"]
        assert kept["commit"] and kept["date"] and kept["machine"] and kept["figures"]
        assert {"Python", "jax", "jaxlib"} <= set(kept["versions"])
        assert not re.search(r"/(home|tmp|root|Users)/", file.read_text()), f"{file.name}: a folder"


def test_words_for_tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import record

    assert [record.number(x) for x in (0.5, 1.96, 197.0, 54123.0)] == [
        "0.50",
        "2.0",
        "200",
        "54 000",
    ]
    assert [record.duration(x) for x in (0.0036, 5e-5, 61.2)] == ["3.6 ms", "50 us", "61 s"]
    assert [record.order(x) for x in (3.2e-16, 0.0, 0.9, None)] == ["3e-16", "0", "0.9", "-"]
    assert record.table(["a", "b"], [["1", "2"]]) == ["| a | b |", "| --- | --- |", "| 1 | 2 |"]
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    words = ["/home/me/benchmarks/x.py", "--save", "--quick", "--plot=/home/me/a.png", "/tmp/me/b"]
    assert record.command(words) == "python benchmarks/x.py --quick --plot=a.png b"


def test_recipes():
    cells = jupytext.read(ROOT / "notebooks" / "recipes.py").cells
    checked = 0
    for here, after in pairwise(cells):
        if here.cell_type == "markdown" and RECIPE.search(here.source):
            assert len(RECIPE.findall(here.source)) == 1  # one answer to a question
            checked += after.cell_type == "code" and "assert " in after.source
    assert checked >= 20


@pytest.mark.slow
def test_code_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    blocks = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
    for block in blocks:
        exec(block, names)
    assert (tmp_path / "fibre.png").stat().st_size > 1000
    assert names["spans"][-1] == pytest.approx(float(names["value"]), rel=1e-12)
    assert names["slope"] > 0  # a stiffer fibre is straighter


def test_errors_point_to_recipes_that_are_there():
    asked = re.compile(r'"(How do I [^"]*\?)"')
    named = {
        question
        for path in (ROOT / "jaxbeads").rglob("*.py")
        for question in asked.findall(path.read_text())
    }
    recipes = {p.strip("# ") for p in RECIPE.findall(prose(ROOT / "notebooks" / "recipes.py"))}
    assert len(named) >= 6 and {" ".join(q.split()) for q in named} <= recipes
    fall = jaxbeads.Scene(jaxbeads.Chain(1.0, 1), 1.0, forces=[jaxbeads.force.Weight([0.0, -1.0])])
    start = jaxbeads.State([[0.0, 0.0]])
    with pytest.raises(ValueError, match=r'see "How do I choose a tolerance\?" in the recipes'):
        jaxbeads.rollout(fall, start, [0.0, 1.0], tolerance=1.0)
    push = jaxbeads.force.ForceField(lambda t, r: jnp.log(0.5 - t) * jnp.ones_like(r))
    broken = jaxbeads.Scene(jaxbeads.Chain(1.0, 1), 1.0, forces=[push])
    with pytest.raises(jaxbeads.SimulationError, match=r'see "How do I find out why it stopped\?"'):
        jaxbeads.simulate(broken, start, [0.0, 1.0, 2.0], substeps=1, progress=False)
