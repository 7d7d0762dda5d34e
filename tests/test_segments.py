"""Segments that interact by a few of their beads, against the sum over all pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeads as jb
from jaxbeads import products, segments, tensors
from jaxbeads.configuration import Configuration
from jaxbeads.constraint import Gears
from jaxbeads.domain import Unbounded
from jaxbeads.force import Bending, Weight
from jaxbeads.mobility import RPY
from jaxbeads.state import Load


def cloud(pieces, bend=1.0, spacing=50.0, seed=0):
    """Bent fibres in random directions on a lattice, with forces and torques."""
    rng, fibres = np.random.default_rng(seed), []
    for k, beads in enumerate(pieces):
        s = np.linspace(-0.5, 0.5, beads)
        along, aside, _ = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        angle = bend * (2 * s + 0.5 * np.sin(5 * s))[:, None]
        x = 2 * np.cumsum(np.cos(angle) * along + np.sin(angle) * aside, axis=0)
        place = np.array(np.unravel_index(k, (8, 8, 8)))
        fibres.append(x - x.mean(axis=0) + spacing * place)
    x = jnp.asarray(np.concatenate(fibres))
    load = Load(*(jnp.asarray(rng.normal(size=x.shape)) for _ in range(2)))
    return Configuration(x, 1.0, 1.0, True, Unbounded(), tuple(pieces)), load


def error(moved, exact):
    pairs = (moved.velocity, exact.velocity), (moved.spin, exact.spin)
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def near(spheres, wanted, nodes=12):
    """The part of all pairs of segments that interact bead by bead."""
    made = segments._segments(spheres.pieces, nodes)
    return float(segments._near(spheres.position, made, segments.APART, wanted).mean())


@pytest.fixture
def small(monkeypatch):
    """Segments of few beads, also of few fibres."""
    monkeypatch.setattr(segments, "BEADS", 25)
    monkeypatch.setattr(segments, "LEAST", 1000)
    monkeypatch.setattr(segments, "LEAST_COARSE", 1000)


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [1e-5, 1e-6, 1e-8, 1e-10])
def test_the_error_is_the_one_asked_for(wanted):
    spheres, load = cloud((100,) * 70, spacing=100.0)
    exact = jax.jit(products.motion)(spheres, load)
    moved = jax.jit(RPY(dense=False, far_error=wanted).product, static_argnums=2)(
        spheres, load, False
    )
    assert 1e-4 * wanted < error(moved, exact) < wanted


@pytest.mark.parametrize("kind", ["both", "force", "torque", "still", "planar"])
def test_segments_of_unequal_fibres(small, kind):
    spheres, load = cloud((50, 50, 75, 26, 60, 80, *(50,) * 19))
    load = {"force": Load(load.force), "torque": Load(torque=load.torque)}.get(kind, load)
    if kind == "planar":
        spheres = cloud((50,) * 24, bend=0.3, spacing=60.0)[0]
        flat = spheres.position[:, :2] + 70 * jnp.repeat(jnp.arange(24), 50)[:, None]
        spheres = Configuration(flat, 1.0, 1.0, True, Unbounded(), spheres.pieces)
        load = Load(load.force[: len(flat), :2], load.torque[: len(flat), :1])
    if kind == "still":
        spheres = Configuration(spheres.position, 1.0, 1.0, False, Unbounded(), spheres.pieces)
        load = Load(load.force)
    assert near(spheres, 1e-6) < 0.5
    exact = tensors.rpy_motion(spheres, load)
    for wanted in (1e-6, 1e-9):
        moved = segments.motion(spheres, load, wanted)
        off = np.abs(moved.velocity - exact.velocity).max() / np.abs(exact.velocity).max()
        assert off < wanted and (kind == "planar" or off > 1e-14)


@pytest.mark.parametrize("together", [1, 7, 8, 1000])
def test_a_kink_and_a_crowd_cost_time_and_no_digits(small, together, monkeypatch):
    monkeypatch.setattr(segments, "TOGETHER", together)
    spheres, load = cloud((50,) * 24)
    # One bead is not where its neighbours put it: its segment meets all others bead by bead.
    x = spheres.position.at[123].add(jnp.array([0.0, 1.0, 0.0]))
    before, after = near(spheres, 1e-6), near(spheres.at(x), 1e-6)
    assert 1 / 48 < after - before < 2 / 48
    crowd = cloud((50,) * 24, spacing=10.0)[0]
    assert near(crowd, 1e-6) > 0.9
    for some in (spheres.at(x), crowd):
        exact = tensors.rpy_motion(some, load)
        for wanted in (1e-6, 1e-9):
            assert error(segments.motion(some, load, wanted), exact) < wanted


def test_beads_a_little_off_their_curve(small):
    # As far as they may be, at random, which is harder than what iterations leave.
    spheres, _ = cloud((50,) * 48, bend=0.2, spacing=30.0)
    rng, wanted = np.random.default_rng(3), 1e-5
    shift = 10 * wanted * 24 * 0.3 * rng.uniform(-1, 1, size=spheres.position.shape)
    rough = spheres.at(spheres.position + shift)
    assert near(rough, wanted) < near(spheres, wanted) + 0.05 < 0.5
    down = jnp.broadcast_to(jnp.array([0.0, 0.0, -1.0]), shift.shape)
    random = Load(*(jnp.asarray(rng.normal(size=shift.shape)) for _ in range(2)))
    for load in (Load(down), random):
        exact = tensors.rpy_motion(rough, load)
        moved = segments.motion(rough, load, wanted)
        off = np.abs(moved.velocity - exact.velocity).max() / np.abs(exact.velocity).max()
        assert 1e-8 < off < wanted


def test_coarse_products(small, monkeypatch):
    spheres, load = cloud((50,) * 48, spacing=30.0)
    moved = RPY(dense=False, far_error=1e-5).coarse(spheres, load)
    assert 1e-4 < error(moved, tensors.rpy_motion(spheres, load)) < 2e-2
    assert RPY(dense=False).coarse(spheres, load) is None
    monkeypatch.setattr(segments, "LEAST_COARSE", 1e6)
    assert RPY(dense=False, far_error=1e-5).coarse(spheres, load) is None


def test_a_bead_that_is_nowhere_is_seen_by_all(small):
    spheres, load = cloud((50,) * 24)
    lost = spheres.at(spheres.position.at[17].set(jnp.nan))
    assert np.isnan(segments.motion(lost, load, 1e-6).velocity).all()


def test_derivatives_are_those_of_the_exact_sum(small):
    spheres, load = cloud((50,) * 24)
    near, exact = RPY(dense=False, far_error=1e-6), RPY(dense=False)
    assert error(near.product(spheres, load, exact=False), exact.motion(spheres, load)) > 1e-10
    assert error(near.product(spheres, load), exact.motion(spheres, load)) < 1e-13
    some = jnp.asarray(np.random.default_rng(2).normal(size=spheres.position.shape))

    def value(x, mobility):
        return jnp.sum(some * mobility.motion(spheres.at(x), load).velocity)

    one, other = (jax.grad(value)(spheres.position, m) for m in (near, exact))
    assert np.array_equal(one, other)


def test_interpolation_is_exact_for_polynomials():
    for beads, nodes in ((50, 10), (25, 24), (8, 8), (3, 10), (1, 8)):
        at, weights = segments.interpolation(beads, nodes)
        degree = min(beads, nodes) - 1
        s = np.linspace(-1, 1, beads) if beads > 1 else np.zeros(1)
        assert len(np.unique(at)) == degree + 1
        assert np.abs(weights @ s[at] ** degree - s**degree).max() < 1e-10
        assert np.abs(weights.sum(axis=1) - 1).max() < 1e-12


def test_errors_that_cannot_be_had_are_refused():
    for wrong in (1e-11, 0.1, -1e-6):
        with pytest.raises(ValueError, match="`far_error` must be 0 or between 1e-10 and 1e-3"):
            RPY(far_error=wrong)


@pytest.mark.slow
def test_a_step_with_segments(small):
    # Iterations of a stage meet segments that are a little off.
    spheres, _ = cloud((50,) * 24, bend=0.2)
    chain = jb.Chain(1.0, spheres.pieces)
    terms = {"constraints": [Gears()], "forces": [Weight([0.0, -1.0, 0.0]), Bending(1e3)]}
    state, ends = jb.State(spheres.position), []
    for wanted in (0.0, 1e-7):
        scene, ts = jb.Scene(chain, 1.0, RPY(far_error=wanted), **terms), jnp.array([0.0, 5.0])
        solution = jb.rollout(scene, state, ts, solver=jb.ESDIRK(substeps=1))
        assert solution.code == 0
        ends.append(solution.final.position)
    moved = np.abs(ends[0] - state.position).max()
    assert moved > 1.0 and 0 < np.abs(ends[1] - ends[0]).max() < 1e-6 * moved


@pytest.mark.parametrize("platform", ["cpu", "cuda", "tpu"])
def test_programs_for_accelerators(small, platform):
    spheres, load = cloud((50,) * 24)

    def run(x):
        return segments.motion(spheres.at(x), load, 1e-6)

    exported = jax.export.export(jax.jit(run), platforms=[platform])(spheres.position)
    assert exported.platforms == (platform,) and "callback" not in exported.mlir_module()


def test_single_precision_of_fibres_that_are_no_neighbours_in_memory(small):
    # Two heaps of fibres far apart, by turns: positions are rounded from a bead of each segment.
    one, load = cloud((50,) * 12)
    both = np.asarray(one.position).reshape(12, 50, 3)
    both = np.stack([both, both + 3e5], axis=1).reshape(-1, 3)
    load = Load(
        *(
            jnp.repeat(x.reshape(12, 50, 3), 2, axis=0).reshape(-1, 3)
            for x in (load.force, load.torque)
        )
    )
    spheres = Configuration(jnp.asarray(both), 1.0, 1.0, True, Unbounded(), (50,) * 24)
    assert near(spheres, 1e-6) < 0.6
    exact = tensors.rpy_motion(spheres, load)
    assert error(segments.motion(spheres, load, 1e-6), exact) < 1e-6
