"""Derivatives of steady and periodic states by all that decides on them, in both modes."""

from functools import cache

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import bent

from jaxbeads import Chain, Scene, State, periodic_state, rollout, steady_state, straight
from jaxbeads.actuation import TravellingWave
from jaxbeads.constraint import Gears, Inextensible, clamped
from jaxbeads.flow import OscillatingShear, Shear
from jaxbeads.force import Bending, BendingEnergy, Potential, Spring, Weight


def turned(state, angle, axis=2, about=None):
    """A state turned by an angle about an axis through a point (by default, the mean of its beads)."""
    dim = state.position.shape[1]
    unit = np.zeros((dim, dim))
    i, j = [k for k in range(dim) if k != axis or dim == 2][:2]
    unit[i, j], unit[j, i] = -1.0, 1.0
    plane = np.zeros((dim, dim))
    plane[i, i] = plane[j, j] = 1.0
    matrix = np.eye(dim) - plane + jnp.cos(angle) * plane + jnp.sin(angle) * unit
    about = jnp.mean(state.position, axis=0) if about is None else about
    arms = eqx.tree_at(lambda s: s.position, state, state.position - about[None])
    arms = jax.tree.map(lambda x: x @ matrix.T, arms)
    return eqx.tree_at(lambda s: s.position, arms, arms.position + about[None])


def moved(state, shift):
    return eqx.tree_at(lambda s: s.position, state, state.position + jnp.asarray(shift)[None])


def jiggled(state, size, seed=3):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: x + size * rng.normal(size=x.shape), state)


@cache
def programs(find, names):
    """Forward mode, with the values, and reverse mode: one program each, whatever is given."""

    def outcomes(x, *given):
        found = find(*given, **{n: x[k] for k, n in enumerate(names)})
        return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(found)])

    def weighted(x, *given):
        found = outcomes(x, *given)
        return weights_of(found) @ found

    def pushed(x, along, *given):
        return jax.jvp(lambda x: outcomes(x, *given), (x,), (along,))

    return jax.jit(pushed), jax.jit(jax.grad(weighted))


def weights_of(found):
    """Weights that no symmetry makes vanish."""
    return jnp.cos(jnp.arange(len(found)) + 0.3)


def check_both_modes(find, point, *given, step=1e-3, tolerance=1e-7):
    """Reverse against forward, and against differences, by each number of `point`."""
    names = list(point)
    x = jnp.asarray([float(point[n]) for n in names])
    scale = np.where(np.abs(x) > 0, np.abs(x), 1.0)
    pushed, reverse = programs(find, tuple(names))
    first = pushed(x, 0 * x, *given)[0]
    assert np.all(np.isfinite(first))
    weights, slope = weights_of(first), np.asarray(reverse(x, *given))
    columns = np.stack([np.asarray(pushed(x, e, *given)[1]) for e in jnp.eye(len(x))])
    size = (np.abs(columns) @ np.abs(weights)).max()  # of the terms of these sums
    assert np.abs(columns @ weights - slope).max() < 1e-10 * size

    def value(x):
        return pushed(x, 0 * x, *given)[0]

    for k, name in enumerate(names):
        h = step * scale[k] * np.eye(len(x))[k]
        near, far = (np.asarray(value(x + n * h) - value(x - n * h)) for n in (1, 2))
        difference = (8 * near - far) / (12 * step * scale[k])
        apart = np.abs(columns[k] - difference).max()
        assert apart < tolerance * max(np.abs(difference).max(), 1e-2), (name, apart, difference)
    return dict(zip(names, columns, strict=True))


SWIMMER = Chain(1.0, 4)


def swim(rigidity, viscosity, frequency, t, start, **options):
    # A mean curvature beside the wave: it swims in circles.
    wave = TravellingWave(0.3, 0.6, frequency, 0.2)
    rest = TravellingWave(0.1, 0.0, 0.0, np.pi / 2)
    forces = [Bending(rigidity, wave), Bending(rigidity, rest)]
    scene = Scene(SWIMMER, viscosity, constraints=[Gears()], forces=forces)
    options = {"solver": diffrax.Heun(), "substeps": 8, "accuracy": 1e-11} | options
    found = periodic_state(scene, start, 1 / frequency, t=t, **options)
    return found.state, found.displacement, found.rotation


POINT = {"rigidity": 40.0, "viscosity": 1.3, "frequency": 0.7, "t": 0.3}


def swim_from(start, angle, x, y, size, **numbers):
    state = moved(turned(jiggled(start, size), angle), jnp.stack([x, y]))
    return swim(**numbers, start=state)


@pytest.mark.parametrize("far", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_swimmer(far):
    # From a shape that is periodic, and from another one: the frequency sets the period as well.
    start = bent(SWIMMER) if far else swim(**POINT, start=bent(SWIMMER))[0]
    point = POINT | {"angle": 0.0, "x": 0.0, "y": 0.0, "size": 0.0}
    slopes = check_both_modes(swim_from, point, start)
    assert np.abs(slopes["frequency"]).max() > 1e-2 and np.abs(slopes["t"]).max() > 1e-2
    # A turn of the start turns all, a shift of it shifts the state alone.
    _, displacement, _ = swim(**POINT, start=start)
    after = slopes["angle"][8:10]
    assert np.abs(after - np.array([-displacement[1], displacement[0]])).max() < 1e-9
    assert np.abs(slopes["x"] - np.array([1.0, 0.0] * 4 + [0.0] * 6)).max() < 1e-9


def test_a_beating_filament():
    # Clamped, with a wave along it: place and direction of its base are those of the start.
    chain = Chain(1.0, 4)
    base = straight(chain, [1.0, 0.0])

    def find(rigidity, viscosity, frequency, t, angle, x, y):
        forces = [Bending(rigidity, TravellingWave(0.3, 0.6, frequency, 0.2))]
        scene = Scene(chain, viscosity, constraints=[Gears(), *clamped()], forces=forces)
        start = moved(turned(base, angle, about=base.position[0]), jnp.stack([x, y]))
        options = {"moving": False, "turning": False, "substeps": 8, "solver": diffrax.Heun()}
        found = periodic_state(scene, start, 1 / frequency, t=t, accuracy=1e-11, **options)
        return found.state, found.displacement

    slopes = check_both_modes(find, POINT | {"angle": 0.1, "x": 0.2, "y": -0.1})
    assert np.abs(slopes["x"] - np.array([1.0, 0.0] * 4 + [0.0] * 2)).max() < 1e-9
    assert np.abs(slopes["angle"]).max() > 1


@pytest.mark.slow
def test_a_filament_in_an_oscillating_shear():
    # Neither held nor free to turn: nothing of the start counts but its place.
    chain = Chain(1.0, 3)

    def find(omega, t, x, y, angle):
        flow = OscillatingShear(0.7, omega, 0.2)
        forces = [Bending(20.0, 0.1), Weight([0.02, -0.1])]
        scene = Scene(chain, 1.0, constraints=[Gears()], forces=forces, flow=flow)
        start = moved(turned(bent(chain), angle), jnp.stack([x, y]))
        found = periodic_state(
            scene,
            start,
            2 * np.pi / omega,
            t=t,
            turning=False,
            substeps=12,
            solver=diffrax.Heun(),
            accuracy=1e-11,
        )
        return found.state, found.displacement

    check_both_modes(find, {"omega": 2.0, "t": 0.3, "x": 0.0, "y": 0.0, "angle": 0.0})


class Stroke(eqx.Module):
    """Energy of four beads in space, all linked by springs whose lengths change in turn."""

    stiffness: jax.Array
    frequency: jax.Array

    def __call__(self, t, position):
        i, j = np.triu_indices(4, 1)
        length = jnp.linalg.norm(position[i] - position[j], axis=1)
        phase = np.array([0.0, 1.0, 2.5, 4.0, 0.5, 3.0])
        rest = 3.0 + 0.5 * jnp.sin(2 * np.pi * self.frequency * t + phase)
        return 0.5 * self.stiffness * jnp.sum((length - rest) ** 2)


def swim_in_space(stiffness, frequency, start):
    scene = Scene(Chain(1.0, (1, 1, 1, 1)), 1.0, forces=[Potential(Stroke(stiffness, frequency))])
    options = {"substeps": 8, "solver": diffrax.Heun(), "accuracy": 1e-11}
    found = periodic_state(scene, start, 1 / frequency, **options)
    return found.state, found.displacement, found.rotation


def swim_in_space_from(start, stiffness, frequency, first, second, third, shift, size):
    state = jiggled(start, size)
    for axis, angle in enumerate((first, second, third)):
        state = turned(state, angle, axis)
    state = moved(state, shift * np.array([0.3, -0.5, 0.8]))
    return swim_in_space(stiffness, frequency, state)


@pytest.mark.slow
@pytest.mark.parametrize("far", [False, True])
def test_a_swimmer_in_space(far):
    corners = State(2.2 * np.array([[0.0, 0, 0], [1.3, 0, 0], [0.2, 1.1, 0.1], [0.4, 0.3, 1.2]]))
    numbers = {"stiffness": jnp.asarray(20.0), "frequency": jnp.asarray(0.8)}
    start = corners if far else swim_in_space(**numbers, start=corners)[0]
    zero = dict.fromkeys(("first", "second", "third", "shift", "size"), 0.0)
    slopes = check_both_modes(swim_in_space_from, numbers | zero, start)
    assert np.abs(slopes["frequency"]).max() > 1e-2
    _, displacement, _ = swim_in_space(**numbers, start=start)
    for axis, name in enumerate(("first", "second", "third")):
        sign = -1.0 if axis == 1 else 1.0  # the plane (x, z) is turned from x to z
        expected = sign * np.cross(np.eye(3)[axis], displacement)
        assert np.abs(slopes[name][12:15] - expected).max() < 1e-8


def test_a_clamped_filament_in_a_flow():
    chain = Chain(1.0, 4)
    base = straight(chain, [0.0, 1.0])

    def find(rigidity, viscosity, shear, x, y, angle):
        forces, held = [Bending(rigidity)], [Gears(), *clamped()]
        scene = Scene(chain, viscosity, constraints=held, forces=forces, flow=Shear(shear))
        start = moved(turned(base, angle, about=base.position[0]), jnp.stack([x, y]))
        found = steady_state(scene, start, moving=False, tolerance=1e-11)
        return found.state, found.velocity

    numbers = {"rigidity": 4e3, "viscosity": 1.0, "shear": 1.5, "x": 0.3, "y": 0.5, "angle": 0.1}
    slopes = check_both_modes(find, numbers)
    assert np.abs(slopes["x"] - np.array([1.0, 0.0] * 4 + [0.0] * 2)).max() < 1e-9
    assert np.abs(slopes["angle"]).max() > 1 and abs(slopes["y"][4]) > 0.05


@pytest.mark.parametrize("dim, model", [(2, Gears), (3, Inextensible)])
def test_a_settling_fibre(dim, model):
    # Weight sets the shape in its plane; in space the start sets the plane.
    chain = Chain(1.0, 5)
    along, down = np.eye(dim)[0], -np.eye(dim)[1]
    bend = Bending if model is Gears else BendingEnergy

    def settle(rigidity, viscosity, t, start):
        forces = [Weight(down), bend(rigidity)]
        scene = Scene(chain, viscosity, constraints=[model()], forces=forces)
        found = steady_state(scene, start, t=t, tolerance=1e-11)
        return found.state, found.velocity

    numbers = {"rigidity": jnp.asarray(60.0), "viscosity": jnp.asarray(1.3), "t": jnp.asarray(0.0)}
    arc = straight(chain, along).position
    arc = State(arc + 0.02 * arc[:, :1] ** 2 * -down[None])
    start = settle(**numbers, start=arc)[0]

    def find(rigidity, viscosity, t, yaw, shift, size):
        # Where the weight leaves a turn free, only turns of the start decide on it.
        state = turned(start, yaw, axis=1) if dim == 3 else jiggled(start, size)
        return settle(rigidity, viscosity, t, moved(state, shift * np.arange(1.0, 1.0 + dim)))

    slopes = check_both_modes(find, numbers | {"yaw": 0.0, "shift": 0.0, "size": 0.0})
    assert np.abs(slopes["rigidity"]).max() > 1e-4
    assert (np.abs(slopes["yaw"]).max() > 1) == (dim == 3)
    assert (np.abs(slopes["size"]).max() > 0.1) == (dim == 2)


def test_a_shape_at_rest_keeps_the_orientation_of_its_start():
    # Springs about a bent shape: from a start that is no rest shape, a turn of it turns what is found.
    chain = Chain(1.0, 4)

    def find(angle, x):
        scene = Scene(chain, 1.0, forces=[Spring(20.0), BendingEnergy(30.0, 0.2)])
        start = moved(turned(bent(chain), angle), jnp.stack([x, -x]))
        return steady_state(scene, start, tolerance=1e-11).state

    check_both_modes(find, {"angle": 1.0, "x": 0.0}, step=5e-3)


@pytest.mark.slow
def test_a_start_that_is_itself_differentiated():
    # The end of a run decides on the orientation of what is found.
    chain = Chain(1.0, 3)

    def find(viscosity):
        wave = TravellingWave(0.5, 0.6, 1.0, 0.2)
        forces = [Bending(10.0, wave)]
        scene = Scene(chain, viscosity, constraints=[Gears()], forces=forces)
        options = {"substeps": 4, "solver": diffrax.Heun()}
        start = rollout(scene, bent(chain), [0.0, 0.3], **options).final
        return periodic_state(scene, start, 1.0, t=0.3, accuracy=1e-11, **options).state

    check_both_modes(find, {"viscosity": 1.0})
