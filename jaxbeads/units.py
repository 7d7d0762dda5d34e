"""What `optimise` measures its problem by (physical units are yours: see the recipe "How do I use
micrometres, piconewtons and seconds?").

Values, a loss and constraints in units that a start shows, and values within bounds as functions of free
ones: what an optimiser sees does not depend on the units of the problem.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ._checks import fail
from ._typing import float_array

NOISE = 1e-12  # a gradient that is so much smaller than others, or than the loss, is none
_LITTLE = 1e-7  # the part of a loss that is nothing to it
_INSIDE = 1e-6  # a start on a bound is moved off it by this part of a unit


class Units(eqx.Module):
    """What the start shows of the problem's units: of each value, the loss, each constraint."""

    values: PyTree
    free: PyTree
    """Of the free values by which the values go; 1 for parts of values' units."""
    loss: Array
    constraints: Array
    size: Array
    """How large the loss is or how much it changes with the values, whichever is larger."""


def bounds_of(start: PyTree, bounds: tuple[Any, Any] | None, many: bool) -> tuple[PyTree, PyTree]:
    """Trees of lower and upper bounds as `start`, or as each of many."""
    sides = (-np.inf, np.inf) if bounds is None else bounds
    if len(sides) != 2:
        fail("bounds", "be a pair (lower, upper)", f"it holds {len(sides)} things")
    trees = []
    for side in sides:
        same = jax.tree.structure(side) == jax.tree.structure(start)
        tree = side if same else jax.tree.map(lambda _, side=side: side, start)
        trees.append(
            jax.tree.map(lambda b, x: jnp.broadcast_to(float_array(b), x.shape[many:]), tree, start)
        )
    for x, low, high in zip(*map(jax.tree.leaves, (start, *trees)), strict=True):
        x, low, high = (np.asarray(a) for a in (x, low, high))
        if not np.all((low <= x) & (x <= high)):
            fail("start", "lie within its bounds", f"{x} does not")
    return trees[0], trees[1]


def _size(x: Array, lower: Array, upper: Array) -> Array:
    """How large values are: over their bounds, or from the one they have; or how large an array is."""
    low, high, below, above = _known(lower, upper)
    gap = jnp.where(low, x - below, jnp.where(high, above - x, 0.0))
    bound = jnp.abs(jnp.where(low, below, jnp.where(high, above, 0.0)))
    whole = jnp.max(jnp.where(low | high, 0.0, jnp.abs(x)), initial=0.0)
    one = jnp.where(low | high, jnp.where(gap > 0, gap, bound), whole)
    return jnp.where(low & high, above - below, one)


def reach(
    start: PyTree, lower: PyTree, upper: PyTree, loss: Array, slope: PyTree, part: Array
) -> PyTree:
    """How far each array of values goes until the loss has changed by a part of itself, if its slope
    stays the same; 0 for arrays that show their size. Those of zeros do not, nor those so small that
    changes of their size are nothing to the loss.
    """

    def one(x: Array, lower: Array, upper: Array, slope: Array) -> Array:
        steepness, sizes = _norm(slope), _size(x, lower, upper)
        little = jnp.any(sizes * steepness <= _LITTLE * jnp.abs(loss))
        far = part * jnp.abs(loss) / jnp.where(steepness == 0, 1.0, steepness)
        return jnp.where(little & (steepness > 0) & jnp.isfinite(far), far, 0.0)

    return jax.tree.map(one, start, lower, upper, slope)


def reached(start: PyTree, lower: PyTree, upper: PyTree, slope: PyTree, far: PyTree) -> PyTree:
    """Values so far down the slope, within their bounds."""

    def one(x: Array, lower: Array, upper: Array, slope: Array, far: Array) -> Array:
        size = _norm(slope)
        return jnp.clip(x - far * (slope / jnp.where(size == 0, 1.0, size)), lower, upper)

    return jax.tree.map(one, start, lower, upper, slope, far)


def shown(
    start: PyTree,
    lower: PyTree,
    upper: PyTree,
    loss: Array,
    constraints: Array,
    slopes: PyTree,
    far: PyTree,
) -> Units:
    """Units from the loss and constraints at the start and their derivatives by the values, the loss's
    first.

    A value's unit is the distance of its bounds, or its own distance from the one it has; without
    bounds an array has one unit, its largest value. If it can go farther (see `reach`), that counts.
    The loss's and the constraints' are what they are or how much they change with the values, whichever
    is larger. What shows nothing has the unit 1.
    """

    def unit(x: Array, lower: Array, upper: Array, far: Array) -> Array:
        both = jnp.isfinite(lower) & jnp.isfinite(upper)
        size = _size(x, lower, upper)
        size = jnp.where(both, size, jnp.maximum(size, far))
        return jnp.where(size > 0, size, 1.0)

    values = jax.tree.map(unit, start, lower, upper, far)
    z = jax.tree.map(free, start, lower, upper, values)

    def bounded(z: PyTree) -> PyTree:
        return jax.tree.map(inside, z, lower, upper, values)

    rates = jax.jvp(bounded, (z,), (jax.tree.map(jnp.ones_like, z),))[1]
    scaled = jax.tree.leaves(jax.tree.map(lambda rows, rate: rows * rate[None], slopes, rates))
    sizes = jnp.stack([jax.vmap(_norm)(rows) for rows in scaled])
    sizes = jnp.maximum(jax.vmap(_norm, 1)(sizes), jnp.abs(jnp.append(loss, constraints)))
    sizes = jnp.where(jnp.isfinite(sizes) & (sizes > 0), sizes, 1.0)
    ones = jax.tree.map(jnp.ones_like, values)
    return Units(values, ones, sizes[0], sizes[1:], sizes[0])


def own(units: Units, lower: PyTree, upper: PyTree) -> Units:
    """Units for an optimiser that is to see the problem as it is: 1, but for what keeps bounds."""

    def one(unit: Array, lower: Array, upper: Array) -> Array:
        return jnp.where(jnp.isfinite(lower) | jnp.isfinite(upper), unit, 1.0)

    def single(unit: Array, lower: Array, upper: Array) -> Array:
        return jnp.where(jnp.isfinite(lower) ^ jnp.isfinite(upper), unit, 1.0)

    values = jax.tree.map(one, units.values, lower, upper)
    free = jax.tree.map(single, values, lower, upper)
    constraints = jnp.ones_like(units.constraints)
    return Units(values, free, jnp.ones_like(units.loss), constraints, units.size)


def _norm(x: Array) -> Array:
    """Norm of an array, also where its squares are too small or too large."""
    size = jnp.max(jnp.abs(x), initial=0.0)
    return size * jnp.linalg.norm(x.ravel() / jnp.where(size == 0, 1.0, size))


def _known(lower: Array, upper: Array) -> tuple[Array, Array, Array, Array]:
    """Which bounds are finite, and bounds with a finite number where there is none, for a derivative
    that is finite on either side of each choice.
    """
    low, high = jnp.isfinite(lower), jnp.isfinite(upper)
    return low, high, jnp.where(low, lower, 0.0), jnp.where(high, upper, 0.0)


def inside(z: Array, lower: Array, upper: Array, unit: Array) -> Array:
    """Values within their bounds: sigmoid, softplus or a multiple of free ones."""
    low, high, below, above = _known(lower, upper)
    both = below + (above - below) * jax.nn.sigmoid(z)
    one = jnp.where(low, below + unit * jax.nn.softplus(z), above - unit * jax.nn.softplus(-z))
    return jnp.where(low & high, both, jnp.where(low | high, one, unit * z))


def free(x: Array, lower: Array, upper: Array, unit: Array) -> Array:
    """The inverse of `inside`, of a value on a bound a little inside."""
    low, high, below, above = _known(lower, upper)
    span = jnp.where(low & high, above - below, 1.0)
    part = jnp.clip((x - below) / span, _INSIDE, 1 - _INSIDE)

    def inverse(gap: Array) -> Array:  # of softplus
        gap = jnp.maximum(gap / unit, _INSIDE)
        return gap + jnp.log(-jnp.expm1(-gap))

    one = jnp.where(low, inverse(x - below), -inverse(above - x))
    both = jnp.log(part / (1 - part))
    return jnp.where(low & high, both, jnp.where(low | high, one, x / unit))


def unbound(slope: Array, z: Array, lower: Array, upper: Array) -> Array:
    """A gradient by free values; where it points away from a bound, as if the bound were not near, where
    free values hardly move the values.
    """
    low, high = jnp.isfinite(lower), jnp.isfinite(upper)
    inward = jnp.where(low & high, slope * z > 0, jnp.where(low, slope < 0, slope > 0))
    rate = jnp.where(
        low & high,
        4 * jax.nn.sigmoid(z) * jax.nn.sigmoid(-z),
        jax.nn.sigmoid(jnp.where(low, z, -z)),
    )
    rate = jnp.maximum(rate, jnp.finfo(z.dtype).tiny)
    return jnp.where((low | high) & inward, slope / rate, slope)
