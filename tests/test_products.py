"""M F of many beads by matrix products, against the tables of all pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeads as jb
from jaxbeads import products, tensors
from jaxbeads.configuration import Configuration
from jaxbeads.constraint import Gears
from jaxbeads.domain import Unbounded
from jaxbeads.force import Bending, Weight
from jaxbeads.mobility import RPY
from jaxbeads.state import Load


def fibres(pieces, dim, seed=0):
    """Bent fibres of touching beads here and there, a hundred radii apart."""
    rng = np.random.default_rng(seed)
    rows = []
    for k, size in enumerate(pieces):
        angle = np.cumsum(0.1 * rng.normal(size=size)) + rng.uniform(0, 7)
        steps = 2 * np.stack([np.cos(angle), np.sin(angle), 0.2 * np.sin(3 * angle)][:dim], axis=1)
        rows.append(np.cumsum(steps, axis=0) + 100 * np.array([k % 3, k // 3, k % 2])[:dim])
    return jnp.asarray(np.concatenate(rows))


def loads(beads, dim, seed=1):
    rng = np.random.default_rng(seed)
    turns = 1 if dim == 2 else 3
    return Load(*(jnp.asarray(rng.normal(size=(beads, n))) for n in (dim, turns)))


def error(a, b):
    largest = [
        (np.abs(x - y).max(), np.abs(y).max())
        for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)
    ]
    return max(off / size for off, size in largest)


PIECES = {
    "fibres": (100, 100, 100, 100),
    "unequal": (150, 9, 64, 65, 30),
    "one": (400,),
    "short": (1, 2, 3, 250, 44),
}


@pytest.mark.parametrize("radii", [False, True], ids=["equal", "unequal"])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("pieces", PIECES.values(), ids=PIECES)
def test_many_beads_move_as_by_all_pairs(pieces, dim, radii):
    beads = sum(pieces)
    x, load = fibres(pieces, dim), loads(beads, dim)
    radius = np.random.default_rng(3).uniform(0.4, 1.4, beads) if radii else 0.9
    spheres = Configuration(x + 1e3, radius, 1.3, True, Unbounded(), pieces)
    whole = tensors.rpy(spheres).motion(load)
    assert error(products.motion(spheres, load), whole) < 2e-13
    single = products.motion(spheres, load, single=True)
    assert error(single, whole) < 1e-6
    if min(pieces) >= products.ROWS[0]:
        assert error(single, whole) > 1e-10  # it is in single precision


@pytest.mark.parametrize("radii", [False, True], ids=["equal", "unequal"])
@pytest.mark.parametrize("most", [100, 397])
def test_beads_that_move_others_are_summed_in_parts(most, radii, monkeypatch):
    monkeypatch.setattr(products, "SOURCES", most)
    x, load = fibres((200, 200), 3), loads(400, 3)
    x = x.at[390].set(x[4] + 0.5)  # two overlap that are no neighbours, in different parts
    radius = np.random.default_rng(3).uniform(0.4, 1.4, 400) if radii else 0.9
    spheres = Configuration(x, radius, 1.3, True, Unbounded(), (200, 200))
    whole = tensors.rpy(spheres).motion(load)
    assert error(products.motion(spheres, load), whole) < 2e-13


@pytest.mark.parametrize("part", ["force", "torque", "still"])
def test_forces_or_torques_alone(part):
    x, load = fibres((150, 150), 3), loads(300, 3)
    rotational = part != "still"
    load = Load(torque=load.torque) if part == "torque" else Load(load.force)
    spheres = Configuration(x, 1.0, 1.0, rotational, Unbounded(), (150, 150))
    whole = tensors.rpy(spheres).motion(load)
    assert error(products.motion(spheres, load), whole) < 1e-13


@pytest.mark.parametrize("rotational", [True, False])
@pytest.mark.parametrize("dim", [2, 3])
def test_beads_of_one_part_among_themselves(dim, rotational):
    x, load = fibres((90,), dim), loads(90, dim)
    load = load if rotational else Load(load.force)
    near = x.at[70].set(x[20] + 0.3)
    for radius in (0.9, np.random.default_rng(3).uniform(0.4, 1.4, 90)):
        for position in (x + 1e3, near, near.at[3].set(near[4])):
            spheres = Configuration(position, radius, 1.3, rotational, Unbounded(), (90,))
            whole = tensors.rpy(spheres).motion(load)
            assert error(products.among(spheres, load), whole) < 2e-13


@pytest.mark.parametrize("off", [-1e-13, 0.0, 1e-13, -1e-9])
def test_neighbours_that_touch_but_for_rounding(off):
    x = 0.9 * (2 + off) * jnp.arange(300.0)[:, None] * jnp.array([[0.6, 0.0, 0.8]]) + 1e3
    load = loads(300, 3)
    spheres = Configuration(x, 0.9, 1.3, True, Unbounded(), (300,))
    whole = tensors.rpy(spheres).motion(load)
    assert error(products.motion(spheres, load), whole) < 2e-12


def test_beads_that_overlap_without_being_neighbours():
    # A ball of overlapping beads, some in one place; and one pair of fibres that cross.
    rng = np.random.default_rng(5)
    ball = jnp.asarray(3 * rng.normal(size=(300, 3))).at[250].set(jnp.zeros(3)).at[7].set(0.0)
    crossing = fibres((150, 150), 3)
    crossing = crossing.at[200].set(crossing[20] + jnp.array([0.3, 0.0, 0.0]))
    load = loads(300, 3)
    for x in (ball, crossing):
        for radius in (1.0, rng.uniform(0.5, 1.5, 300)):
            spheres = Configuration(x, radius, 1.0, True, Unbounded(), (150, 150))
            whole = tensors.rpy(spheres).motion(load)
            assert error(products.motion(spheres, load), whole) < 1e-13
            assert error(products.motion(spheres, load, single=True), whole) < 1e-6


def test_multipliers_by_products_and_their_derivatives():
    # Iterations take the products, derivatives the sums pair by pair.
    chain = jb.Chain(1.0, (90, 120, 90))
    state = jb.State(fibres(chain.fibres, 3))
    shift = jnp.asarray(np.random.default_rng(6).normal(size=state.position.shape))
    found = []
    for dense in (False, True):

        def velocity(x, rigidity, dense=dense):
            forces = [Weight([0.0, -1.0, 0.3]), Bending(rigidity)]
            scene = jb.Scene(chain, 1.0, RPY(dense=dense), constraints=[Gears()], forces=forces)
            return jb.dynamics.motion(0.0, jb.State(x), scene).velocity

        at = state.position, jnp.asarray(1e3)
        moved, slope = jax.jvp(velocity, at, (shift, jnp.asarray(1e2)))
        pulled = jax.grad(lambda x, k: jnp.sum(shift * velocity(x, k)), argnums=(0, 1))(*at)
        found.append((moved, slope, *pulled))
    for one, other in zip(*found, strict=True):
        assert np.abs(one - other).max() < 1e-9 * np.abs(other).max()
