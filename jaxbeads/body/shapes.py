"""Shapes of bodies: each function returns a `Body`, and its numbers may be traced and differentiated."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import fail, finite, known, non_zero, positive, shape, whole
from .._functions import trial, value_of
from .._typing import float_array
from ..geometry import norm, normals, unit
from .base import Body

_ORIGIN, _ALONG_X = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)


def _vector(name: str, value: Any) -> Array:
    vector = float_array(value)
    shape(name, vector, (3,))
    finite(name, vector)
    return vector


def _axes(direction: Any) -> Float[Array, "3 3"]:
    """Rows: a direction and two at right angles to it; those of space along x."""
    along = _vector("direction", direction)
    non_zero("direction", along)
    along = unit(along)
    first, _ = normals(along)
    # y, or where there is little of it left across the direction, any other.
    across = jnp.asarray([0.0, 1.0, 0.0]) - along[1] * along
    across = unit(jnp.where(jnp.abs(along[1]) < 0.9, across, first))
    return jnp.stack([along, across, jnp.cross(along, across)])


def _number(name: str, value: Any) -> Array:
    number = float_array(value)
    shape(name, number, ())
    positive(name, number)
    return number


def sphere(radius: Any, centre: Any = _ORIGIN) -> Body:
    """A sphere as one bead, exact when alone.

    **Arguments**: radius [length]; centre, `(3,)` [length].

    >>> import jaxbeads as jb
    >>> head = jb.body.sphere(6.0, centre=[-7.0, 0.0, 0.0])
    >>> print(head.position, head.radius)
    [[-7.  0.  0.]] 6.0
    """
    return Body(_vector("centre", centre)[None], _number("radius", radius))


def _spread(beads: int) -> Float[Array, "beads 3"]:
    """Points spread evenly over the unit sphere, along a spiral by the golden angle."""
    place = np.arange(beads) + 0.5
    height = 1 - 2 * place / beads
    angle = np.pi * (1 + 5**0.5) * place
    across = np.sqrt(1 - height**2)
    return jnp.asarray(np.stack([height, across * np.cos(angle), across * np.sin(angle)], axis=1))


def shell(radius: Any, beads: int, centre: Any = _ORIGIN) -> Body:
    """A sphere as a layer of beads, which tends to the sphere as they become more, see `ellipsoid`. Its
    friction is that of the sphere to 0.3 % from 50 beads on.

    **Arguments**: radius of the sphere [length]; number of beads, at least 4; centre, `(3,)` [length].

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> drag = jb.locomotion.resistance(jb.body.shell(2.0, beads=60))[0, 0]
    >>> print(f"{drag / (6 * jnp.pi):.2f}")
    2.00
    """
    radius = _number("radius", radius)
    return ellipsoid(jnp.stack([radius] * 3), beads, centre=centre)


_ROUNDS = 8
"""Of Newton's method, for distances of beads along a curve: more than enough."""

_LAYER = 0.64
"""How far from their centres, over their radius, a layer of touching beads has the surface of the body
for which the fluid takes them. Found for spheres, whose friction it makes exact to 0.2 % (50 to 200
beads): without it, with centres on the surface, a sphere of 200 beads has 9 % more friction and resists
rotation by 28 % more.
"""


def ellipsoid(semi_axes: Any, beads: int, centre: Any = _ORIGIN, direction: Any = _ALONG_X) -> Body:
    """An ellipsoid as a layer of beads that touch, as in a hexagonal packing: each as large as its share
    of the surface, and a little inside, so that the friction is right at any number.

    Points that are even on a sphere are stretched: beads are larger where it is flat.

    **Arguments**: half the length of each axis, `(3,)` [length]; number of beads, at least 4, and many
    for a slender one; centre [length]; direction of the first axis, the second being as near to y as it
    can be.

    >>> import jaxbeads as jb
    >>> egg = jb.body.ellipsoid([2.0, 1.0, 1.0], beads=50)
    >>> print(f"{jb.locomotion.resistance(egg)[0, 0]:.1f}")  # 22.69 of the spheroid
    22.7
    """
    axes = _vector("semi_axes", semi_axes)
    positive("semi_axes", axes)
    whole("beads", beads, 4)
    on_sphere = _spread(beads)
    # An element of the sphere with normal n is stretched by a b c |n/(a, b, c)|.
    normal, volume = on_sphere / axes[None], jnp.prod(axes)
    long = jnp.linalg.norm(normal, axis=1)
    radii = jnp.sqrt(2 * np.pi / np.sqrt(3) / beads * volume * long)
    # The layer's own surface is smaller, by about this factor along each direction.
    radii = radii / (1 + _LAYER * jnp.mean(radii) / jnp.cbrt(volume))
    inside = on_sphere * axes[None] - _LAYER * (radii / long)[:, None] * normal
    return Body(inside @ _axes(direction) + _vector("centre", centre)[None], radii)


def rod(beads: int, radius: Any = 1.0, centre: Any = _ORIGIN, direction: Any = _ALONG_X) -> Body:
    """A straight row of touching beads.

    **Arguments**: number of beads; their radius [length]; centre, `(3,)` [length]; direction.

    >>> import jaxbeads as jb
    >>> print(jb.body.rod(3).position[:, 0])
    [-2.  0.  2.]
    """
    whole("beads", beads, 1)
    radius = _number("radius", radius)
    along = radius * (2 * jnp.arange(beads) - (beads - 1))
    return Body(along[:, None] * _axes(direction)[:1] + _vector("centre", centre)[None], radius)


def _chord(radius: Array, wave: Array, length: Array) -> Array:
    """Step dx along the axis of a helix between points at a distance: the root of
    dx^2 + 4 R^2 sin^2(k dx/2) = l^2, by Newton's method from equal arcs, where it is convex.
    """

    def excess(step: Array) -> Array:
        return step**2 + (2 * radius * jnp.sin(wave * step / 2)) ** 2 - length**2

    step = length / jnp.sqrt(1 + (radius * wave) ** 2)
    for _ in range(6):
        slope = 2 * step + 2 * radius**2 * wave * jnp.sin(wave * step)
        step = step - excess(step) / slope
    return step


def helix(
    radius: Any,
    pitch: Any,
    *,
    turns: Any = None,
    beads: int | None = None,
    thickness: Any = 1.0,
    start: Any = _ORIGIN,
    direction: Any = _ALONG_X,
) -> Body:
    """A right-handed helix of touching beads,

        r = start + (x, R cos kx, R sin kx),   k = 2 pi/pitch,

    whose centres are 2a apart; the first is at x = 0.

    **Arguments**

    - `radius`: R, of the centres about the axis [length].
    - `pitch`: rise in a turn [length]; negative in a left-handed one.
    - `turns`: number of turns of the arc that the beads are to cover with their diameters; there are as
      many beads as fit. Or `beads`, their number, through which numbers of the shape may be traced.
    - `thickness`: a, of a bead [length].
    - `start`: on the axis, beside the first bead [length]; `direction`: of the axis; the first bead is
      as near to y from it as it can be.

    **Raises** `ValueError` if not one of `turns` and `beads` is given, for turns of a traced shape, and
    for numbers out of range.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> tail = jb.body.helix(radius=3.0, pitch=14.0, turns=3)
    >>> apart = jnp.linalg.norm(jnp.diff(tail.position, axis=0), axis=1)
    >>> print(tail.beads, tail.position[0], apart.round(12).min(), apart.round(12).max())
    35 [0. 3. 0.] 2.0 2.0
    """
    radius, pitch = _number("radius", radius), float_array(pitch)
    shape("pitch", pitch, ())
    finite("pitch", pitch)
    non_zero("pitch", pitch[None])
    a = _number("thickness", thickness)
    if (turns is None) == (beads is None):
        fail("turns", "be given, or `beads`, but not both", f"turns {turns}, beads {beads}")
    if beads is None:
        arcs = _number("turns", turns) * jnp.sqrt(pitch**2 + (2 * np.pi * radius) ** 2) / (2 * a)
        if not known(arcs):
            fail("turns", "be replaced by `beads` where the shape is traced", "it is given")
        beads = max(1, int(np.floor(float(arcs) + 1e-9)))
    whole("beads", beads, 1)
    wave = 2 * np.pi / jnp.abs(pitch)
    x = _chord(radius, wave, 2 * a) * jnp.arange(beads)
    hand = jnp.sign(pitch)
    local = [x, radius * jnp.cos(wave * x), hand * radius * jnp.sin(wave * x)]
    return Body(jnp.stack(local, axis=1) @ _axes(direction) + _vector("start", start)[None], a)


def strand(curve: Callable[[Array], Any], beads: int, thickness: Any = 1.0) -> Body:
    """Touching beads along any curve, from its point at 0 on: each at the distance 2a from the one
    before.

    **Arguments**: function of a number that returns a point, `(3,)` [length], along which the curve goes
    on as the number grows; number of beads; a, their radius [length].

    **Raises** `ValueError` for what is no such function.

    >>> import jax.numpy as jnp
    >>> import jaxbeads as jb
    >>> ring = jb.body.strand(lambda s: jnp.stack([jnp.cos(s), jnp.sin(s), 0.0 * s]), 6, thickness=0.5)
    >>> print(ring.position[3, 0].round(12))  # six equal chords of a circle
    -1.0
    """
    whole("beads", beads, 1)
    a = _number("thickness", thickness)

    def point(s: Array) -> Array:
        return value_of("curve", "a number", curve, s, shapes=((3,),), dtype=a.dtype)

    trial(point, jnp.zeros((), a.dtype))

    def after(s: Array, _: None) -> tuple[Array, Array]:
        """The next bead's number, by Newton's method from the tangent's."""
        start = point(s)

        def nearer(_: Any, end: Array) -> Array:
            there, slope = jax.jvp(point, (end,), (jnp.ones_like(end),))
            chord = there - start
            return end - (chord @ chord - 4 * a**2) / (2 * chord @ slope)

        speed = norm(jax.jvp(point, (s,), (jnp.ones_like(s),))[1])
        end = lax.fori_loop(0, _ROUNDS, nearer, s + 2 * a / speed)
        return end, point(end)

    zero = jnp.zeros((), a.dtype)
    rest = lax.scan(after, zero, None, length=beads - 1)[1]
    return Body(jnp.concatenate([point(zero)[None], rest]), a)


def read_points(path: str | Path, radius: Any = None) -> Body:
    r"""A body from a file of text: one bead a row, x, y, z and, where no radius is given, its radius,
    between spaces, tabs or commas. What follows a # is not read.

    **Arguments**: the file; one radius for all [length], or none if each row has its own.

    **Raises** `ValueError` for a file that cannot be read, and for rows of other lengths.

    >>> from pathlib import Path
    >>> import jaxbeads as jb
    >>> _ = Path("two.txt").write_text("# x y z a\n0 0 0 1.0\n2.5 0 0 1.5\n")
    >>> print(jb.body.read_points("two.txt").radius)
    [1.  1.5]
    """
    path, columns = Path(path), 4 if radius is None else 3
    try:
        lines = [line.split("#")[0] for line in path.read_text().splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        fail("path", "be a file of text that can be read", f"{path} is not: {error}")
    rows = [(k + 1, line.replace(",", " ").split()) for k, line in enumerate(lines)]
    rows = [(number, words) for number, words in rows if words]
    for number, words in rows:
        if len(words) != columns:
            must = f"hold rows of {columns} numbers, x y z{' a' if columns == 4 else ''}"
            fail("path", must, f"row {number} of {path} holds {len(words)}")
    try:
        values = np.array([[float(word) for word in words] for _, words in rows])
    except ValueError as error:
        fail("path", "hold numbers", f"{path} holds others: {error}")
    if len(values) == 0:
        fail("path", "hold at least one bead", f"{path} holds none")
    return Body(values[:, :3], values[:, 3] if radius is None else radius)
