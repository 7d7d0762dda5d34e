"""Sweeps: labels, the same numbers as one after the other, and members that fail."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent

from jaxbeads import Chain, Scene, rollout, sweep
from jaxbeads.constraint import Gears
from jaxbeads.force import Bending, ForceField, Weight
from jaxbeads.observables import end_to_end_distance

CHAIN = Chain(1.0, 5)
STATE = bent(CHAIN)
TS = np.linspace(0.0, 4.0, 5)


def build(rigidity, weight):
    forces = [Bending(rigidity), Weight(jnp.stack([0.0 * weight, -weight]))]
    return Scene(CHAIN, 1.0, constraints=[Gears()], forces=forces), STATE


def measure(solution, scene):
    position = solution.states.position
    return {"span": end_to_end_distance(position[-1]), "path": position.mean(axis=1)}


def quiet(build, axes, **options):
    return sweep(build, axes, TS, measure, progress=False, **options)


AXES = {"rigidity": [1.0, 5.0, 20.0], "weight": [0.1, 0.5]}


@pytest.fixture(scope="module")
def table():
    return quiet(build, AXES, chunk=4)


def test_labels_and_numbers(table):
    assert dict(table.sizes) == {"rigidity": 3, "weight": 2, "path_0": 5, "path_1": 2}
    assert np.all(table.code == 0) and table.attrs["failures"] == []
    assert np.all(table.steps > 0)
    one = jax.jit(lambda rigidity, weight: rollout(*build(rigidity, weight), TS).states.position)
    for rigidity in AXES["rigidity"]:
        member = table.sel(rigidity=rigidity, weight=0.5)
        position = one(rigidity, 0.5)
        assert abs(member.span - end_to_end_distance(position[-1])) < 1e-9
        assert np.abs(member.path - position.mean(axis=1)).max() < 1e-9


def test_paired_axes():
    axes = {"rigidity": [1.0, 20.0], "weight": [0.5, 0.1]}
    pairs = quiet(build, axes, paired=True, substeps=20)
    table = quiet(build, axes, substeps=20)
    assert dict(pairs.sizes)["member"] == 2
    for k in (0, 1):
        one = table.sel(rigidity=axes["rigidity"][k], weight=axes["weight"][k])
        assert abs(pairs.span[k] - one.span) < 1e-12
        assert pairs.weight[k] == axes["weight"][k]


def test_a_member_that_fails_changes_no_other():
    # Equal steps, far too long for the one stiff fibre, which breaks down; the same program and chunk.
    axes = {"rigidity": [1.0, 5.0, 20.0, 10.0], "weight": [0.5]}
    fine = quiet(build, axes, substeps=20)
    bad = quiet(build, {**axes, "rigidity": [1.0, 5.0, 1e6, 10.0]}, substeps=20)
    assert list(bad.code.values.ravel() != 0) == [False, False, True, False]
    assert np.isnan(bad.span[2, 0]) and np.isnan(bad.path[2]).all()
    for k in (0, 1, 3):
        assert np.array_equal(bad.path[k], fine.path[k]) and bad.span[k, 0] == fine.span[k, 0]
    (sentence,) = bad.attrs["failures"]
    assert sentence.startswith("rigidity = 1e+06, weight = 0.5: broke down (code")
    assert "step" in sentence and "bead" in sentence and "Bending" in sentence


def test_members_that_fail_with_adaptive_steps():
    # A force that is not finite beyond a height: only the heavy fibre comes there.
    def wall(weight):
        force = ForceField(lambda t, x: jnp.where(x[..., 1:] > -6.0, 0.0 * x, jnp.nan))
        scene, state = build(jnp.asarray(5.0), weight)
        return Scene(CHAIN, 1.0, constraints=[Gears()], forces=[*scene.forces, force]), state

    options = {"solver": diffrax.Tsit5(), "progress": False}
    found = sweep(wall, {"weight": [0.1, 50.0]}, TS, measure, **options)
    alone = sweep(wall, {"weight": [0.1, 0.1]}, TS, measure, **options)
    assert found.code[0] == 0 and found.code[1] != 0
    assert np.array_equal(found.path[0], alone.path[0])
    assert "weight = 50: broke down" in found.attrs["failures"][0]


def test_a_measure_that_is_not_finite():
    def odd(solution, scene):
        return {"odd": jnp.log(scene.forces[0].rigidity - 2.0)}

    found = sweep(
        build, {"rigidity": [1.0, 5.0], "weight": [0.5]}, TS, odd, progress=False, substeps=20
    )
    assert list(found.code.values.ravel()) == [4, 0]
    assert found.attrs["failures"] == [
        "rigidity = 1, weight = 0.5: what is measured is not finite (code 4)"
    ]


@pytest.mark.parametrize(
    "axes, options, sentence",
    [
        ({}, {}, "`axes` must name at least one parameter"),
        ({"rigidity": [[1.0]], "weight": [1.0]}, {}, "must be a sequence of numbers"),
        ({"rigidity": [1.0, np.nan], "weight": [1.0]}, {}, "must be finite"),
        ({"rigidity": [1.0, 2.0], "weight": [1.0]}, {"paired": True}, "must be equally long"),
        (AXES, {"chunk": 0}, "`chunk` must be at least 1"),
    ],
)
def test_what_is_refused(axes, options, sentence):
    with pytest.raises(ValueError, match=sentence):
        quiet(build, axes, **options)


def test_functions_are_refused_by_name():
    with pytest.raises(ValueError, match="`build` must return a scene and a state"):
        quiet(lambda rigidity, weight: rigidity, AXES)
