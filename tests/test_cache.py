"""Compiled programs on disk."""

import os
import subprocess
import sys

import pytest

import jaxbeads

PROGRAM = """
import sys
import jax
import jaxbeads as jb
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name.endswith("/cache_hits")))
print(jb.enable_cache(sys.argv[1] if len(sys.argv) > 1 else None))
chain = jb.Chain(1.0, 3)
scene = jb.Scene(chain, 1.0, forces=[jb.force.Weight([0.0, -1.0])])
jb.rollout(scene, jb.straight(chain, [1.0, 0.0]), [0.0, 1.0], substeps=2, single_precision=True)
print(sum(hits))
"""


def run(*arguments, **environment):
    """The folder and the number of programs that were found there."""
    mine = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    command = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    done = subprocess.run(
        command, env=mine | environment, check=True, capture_output=True, text=True
    )
    folder, hits = done.stdout.split()
    return folder, int(hits)


def test_the_second_process_finds_the_programs(tmp_path):
    def programs():
        return sorted(tmp_path.glob("*-cache"))

    folder, again = run(tmp_path)  # small programs that are the same twice
    first = programs()
    assert folder == str(tmp_path) and len(first) > 3
    folder, hits = run(tmp_path)
    assert hits == again + len(first) and programs() == first
    # Where nothing is said, in the user's own folder, unless JAX is told.
    assert run(XDG_CACHE_HOME=str(tmp_path)) == (str(tmp_path / "jaxbeads"), again)
    assert run(JAX_COMPILATION_CACHE_DIR=str(tmp_path)) == (str(tmp_path), hits)


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="`folder` must be one that can be made"):
        jaxbeads.enable_cache(tmp_path / "file" / "folder")
