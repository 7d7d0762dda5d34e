"""The reference: every public name has a docstring with an example that runs; pages are made of them."""

import doctest
import inspect
import io
import re
import runpy
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import jaxbeads
from jaxbeads._compat import forget_cache

ROOT = Path(__file__).parents[1]
PAGES = ROOT / ".ci" / "pages.py"
LISTS = runpy.run_path(str(PAGES))
MODULES = {module.__name__: module for module in LISTS["modules"]()}
PARSER = doctest.DocTestParser()


def own_text(thing):
    """A docstring, not that of a base class."""
    return inspect.cleandoc(thing.__doc__ or "")


def public():
    """By module, what its public names stand for: functions and classes, each once. The package comes
    last, which hands on what is elsewhere."""
    seen = set()
    for title, module in sorted(MODULES.items(), reverse=True):
        things = {name: getattr(module, name) for name in LISTS["names"](module)}
        new = {n: x for n, x in things.items() if callable(x) and id(x) not in seen}
        seen |= {id(x) for x in new.values()}
        yield title, new


PUBLIC = dict(public())


@pytest.fixture
def cache():
    """What `enable_cache` sets is put back."""
    names = [
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    ]
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    forget_cache()


@pytest.mark.parametrize("title", PUBLIC)
def test_every_name_has_an_example_that_runs(title, tmp_path, monkeypatch, cache):
    monkeypatch.chdir(tmp_path)
    runner, said = doctest.DocTestRunner(verbose=False), io.StringIO()
    for name, thing in PUBLIC[title].items():
        text = own_text(thing)
        assert text.partition(">>>")[0].strip(), f"{title}.{name} has no docstring"
        example = PARSER.get_doctest(text, {}, f"{title}.{name}", None, None)
        assert example.examples, f"{title}.{name} has no example"
        runner.run(example, out=said.write)
    assert runner.summarize(verbose=False).failed == 0, said.getvalue()


def test_every_example_is_run():
    """None is where it is not looked for, as in a module or a method."""
    written = sum(p.read_text().count(">>> ") for p in Path(jaxbeads.__file__).parent.rglob("*.py"))
    texts = [own_text(thing) for new in PUBLIC.values() for thing in new.values()]
    assert written == sum(len(PARSER.get_examples(text)) for text in texts)


def test_what_docstrings_refer_to_is_there():
    """Names of public modules, as `observables.power`."""
    files = Path(jaxbeads.__file__).parent.rglob("*.py")
    text = " ".join(path.read_text() for path in files)
    named = re.findall(r"`((?:jaxbeads\.)?[a-z_]+)\.(\w+)`", text)
    found = {(f"jaxbeads.{m.removeprefix('jaxbeads.')}", name) for m, name in named}
    found = {(m, name) for m, name in found if m in MODULES}
    assert len(found) > 5
    assert not [pair for pair in found if not hasattr(MODULES[pair[0]], pair[1])]


def test_pages(tmp_path):
    """They are made without a warning, link to one another and ask for nothing from elsewhere."""
    subprocess.run([sys.executable, PAGES, tmp_path], check=True, timeout=100)
    pages = {p.relative_to(tmp_path).as_posix(): p.read_text() for p in tmp_path.rglob("*.html")}
    made = {name.replace(".", "/") + ".html" for name in MODULES}
    assert set(pages) == made | {"index.html"}
    names = {page: set(re.findall(r'id="([^"]+)"', text)) for page, text in pages.items()}
    for page, text in pages.items():
        assert not re.search(r'(?:src|href)="(?:https?:)?//(?!pdoc\.dev)', text), page
        for link in re.findall(r'href="([^"#]*\.html)?(?:#([^"]*))?"', text):
            target = (tmp_path / page).parent.joinpath(link[0] or Path(page).name).resolve()
            target = target.relative_to(tmp_path.resolve()).as_posix()
            assert target in pages, f"{page}: {link[0]} leads nowhere"
            if "." not in link[1]:  # a class's own: what it inherits has no place on its page
                assert not link[1] or link[1] in names[target], f"{page}: {link} leads nowhere"
