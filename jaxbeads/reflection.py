"""The flow of a source's image behind a no-slip wall, at a sphere.

Let v, p be the flow of the mirrored source behind the plane, w the component of v along the plane's
normal n, z the height above the plane and J the mirror, J x = x - 2 n (n.x). Lorentz's reflection

    u = -J v - 2 z grad w + (z^2/mu) grad p

is a Stokes flow that cancels the flow of the source itself on the wall. Its mean over the surface of a
sphere of radius a is (1 + a^2/6 lap) u at the centre, with lap u = (2 - J) grad p/mu - 4 (n.grad) grad w
+ 2 z (n.grad) grad p/mu, and its half curl is -curl v/2 + 2 grad w x n - (z/mu) grad p x n. All that is
needed is a source's v and p with two derivatives. Those of forces and torques spread over a sphere are
worked out (`Pairs`), those of the stresslet of a sphere in a straining flow found by differentiation.
The result is that of Swan & Brady, Phys. Fluids 19 (2007) 113306, for spheres of any radii.

Vectors are lists of components in space, of which `None` is zero.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

Component = Array | None
Vector = Sequence[Component]
_AXES = ((1, 2), (2, 0), (0, 1))


def _times(*factors: Component | float) -> Component:
    product: Component = None
    for factor in factors:
        if factor is None:
            return None
        product = jnp.asarray(factor) if product is None else product * factor
    return product


def _plus(*terms: Component) -> Component:
    some = [x for x in terms if x is not None]
    return reduce(jnp.add, some) if some else None


def scaled(number: Component | float, vector: Vector) -> Vector:
    """A number times a vector."""
    return [_times(number, x) for x in vector]


def total(*vectors: Vector) -> Vector:
    """The sum of vectors."""
    return [_plus(*parts) for parts in zip(*vectors, strict=True)]


def _dot(a: Vector, b: Vector) -> Component:
    return _plus(*(_times(x, y) for x, y in zip(a, b, strict=True)))


def _cross(a: Vector, b: Vector) -> Vector:
    return [_plus(_times(a[j], b[k]), _times(-1.0, a[k], b[j])) for j, k in _AXES]


def there(component: Component, like: Array) -> Array:
    """A component, as zeros if it is `None`."""
    return jnp.zeros_like(like) if component is None else component


def _square(r: Vector) -> Array:
    return reduce(jnp.add, [x * x for x in r if x is not None])


class _Source(NamedTuple):
    """The flow of a mirrored source, without 8 pi mu: v, half its curl, grad w, (n.grad) grad w, and the
    same of the pressure over the viscosity (`None` without a pressure).
    """

    velocity: Vector
    spin: Vector
    slope: Vector
    along: Vector
    push: Vector | None = None
    push_along: Vector | None = None


def _mirrored(vector: Vector, normal: Vector) -> Vector:
    return total(vector, scaled(_times(-2.0, _dot(normal, vector)), normal))


class Pairs(NamedTuple):
    """What images of loads do to spheres, without 8 pi mu: coefficients of r, n and the loads."""

    r: Vector
    normal: Vector
    across: Vector
    """r x n."""
    force: tuple[Array, ...]
    """In the velocity of a mirrored force f, of f, (r.f) r, (n.f) r, (r.f) n, (n.f) n."""
    force_spin: tuple[Array, ...]
    """In its spin, of f x r, f x n, (r.f) r x n, (n.f) r x n."""
    torque: tuple[Array, ...]
    """In the velocity of a mirrored torque t, of t x r, n x t, (t.r x n) r, (t.r x n) n."""
    torque_spin: tuple[Array, ...]
    """In its spin, of t, its part along the wall, (r.t) r, (t.r x n) r x n."""

    def by_force(self, force: Vector) -> tuple[Vector, Vector]:
        """Velocity and spin under a force."""
        r, n = self.r, self.normal
        f = _mirrored(force, n)
        s, fn = _dot(r, f), _dot(n, f)
        of_f, sr, nr, sn, nn = self.force
        along, up = _plus(_times(s, sr), _times(fn, nr)), _plus(_times(s, sn), _times(fn, nn))
        velocity = total(scaled(of_f, f), scaled(along, r), scaled(up, n))
        of_r, of_n, s_across, n_across = self.force_spin
        arm = total(scaled(of_r, r), scaled(of_n, n))
        turn = _plus(_times(s, s_across), _times(fn, n_across))
        return velocity, total(_cross(f, arm), scaled(turn, self.across))

    def by_torque(self, torque: Vector) -> tuple[Vector, Vector]:
        """The same under a torque, which a mirror turns the other way."""
        r, n = self.r, self.normal
        t = scaled(-1.0, _mirrored(torque, n))
        q, tn = _dot(t, self.across), _dot(n, t)
        of_turn, of_m, along, up = self.torque
        velocity = total(
            _cross(t, total(scaled(of_turn, r), scaled(_times(-1.0, of_m), n))),
            scaled(_times(q, along), r),
            scaled(_times(q, up), n),
        )
        of_t, flat, of_r, of_across = self.torque_spin
        spin = total(
            scaled(of_t + flat, t),
            scaled(_times(-1.0, tn, flat), n),
            scaled(_times(_dot(r, t), of_r), r),
            scaled(_times(q, of_across), self.across),
        )
        return velocity, spin


def pairs(
    r: Vector, height: Array, normal: Vector, z: Array, radius: Array, source: Array
) -> Pairs:
    """Of separations from the images.

    **Arguments**: separation and its part along the normal; normal; height and radius of the sphere
    that is moved; radius of the source.
    """
    share, alpha = radius * radius / 6, source * source / 3
    i2 = 1 / _square(r)
    i1 = jnp.sqrt(i2)
    i3 = i1 * i2
    i5, i7 = i3 * i2, i3 * i2 * i2
    g2, h1 = i3 - 3 * alpha * i5, -i3 - 3 * alpha * i5
    h2, k1 = -3 * i5 + 15 * alpha * i7, 3 * i5 + 15 * alpha * i7
    k2 = 15 * i7 - 105 * alpha * i7 * i2
    hh, flow, pull = height * height, i1 + alpha * i3, 12 * share * z * i5
    force = (
        -flow
        - 2 * z * g2 * height
        - 4 * share * (h2 * hh + g2)
        + 2 * (z * z + share) * i3
        - pull * height,
        -g2
        - 2 * z * h2 * height
        - 4 * share * (k2 * hh + h2)
        - 6 * (z * z + share) * i5
        + 60 * share * z * height * i7,
        -2 * z * h1 - 4 * share * (k1 + h2) * height - pull,
        2 * (height - z) * g2 - (8 * share * h2 + 12 * share * i5) * height - pull,
        2 * flow - 4 * share * (h1 + g2 - i3),
    )
    force_spin = (
        -i3,
        2 * (g2 * height - z * i3),
        2 * h2 * height + 6 * z * i5,
        2 * h1,
    )
    torque = (
        -i3,
        12 * share * height * i5 - 2 * z * i3,
        6 * z * i5 - 60 * share * height * i7,
        2 * i3 + 12 * share * i5,
    )
    torque_spin = (0.5 * i3, 2 * i3, -1.5 * i5, -6 * i5)
    return Pairs(r, normal, _cross(r, normal), force, force_spin, torque, torque_spin)


def derived(
    velocity: Callable[[list[Array]], Vector],
    pressure: Callable[[list[Array]], Array],
    r: list[Array],
    normal: Vector,
) -> _Source:
    """A source's derivatives by differentiation of its flow and its pressure over the viscosity."""
    count = len(r)

    def unit(k: int) -> list[Array]:
        return [jnp.ones_like(x) if j == k else jnp.zeros_like(x) for j, x in enumerate(r)]

    def slopes(function: Callable[[list[Array]], Array]) -> Callable[[list[Array]], list[Array]]:
        return lambda r: [jax.jvp(function, (r,), (unit(k),))[1] for k in range(count)]

    along = [jnp.broadcast_to(jnp.asarray(n), x.shape) for n, x in zip(normal, r, strict=False)]

    def whole(vector: Sequence[Array]) -> Vector:
        return [*vector, *[None] * (3 - count)]

    def across(r: list[Array]) -> Array:
        return there(_dot(normal, velocity(r)), r[0])

    slope, slope_along = jax.jvp(slopes(across), (r,), (along,))
    push, push_along = jax.jvp(slopes(pressure), (r,), (along,))
    rows = [
        slopes(lambda r, i=i: there(velocity(r)[i], r[0]))(r) for i in range(count)
    ]  # d v_i/d r_k

    def half(i: int, j: int) -> Component:
        return 0.5 * (rows[j][i] - rows[i][j]) if max(i, j) < count else None

    spin = [half(j, k) for j, k in _AXES]
    return _Source(
        velocity(r), spin, whole(slope), whole(slope_along), whole(push), whole(push_along)
    )


def strained(
    r: list[Array], normal: Vector, strain: Sequence[Sequence[Array]], radius: Array
) -> _Source:
    """Of a sphere that resists a straining flow."""
    rows: list[Vector] = [[*row, *[None] * (3 - len(r))] for row in strain]
    # J E J, rows first, then columns.
    half = [_mirrored(row, normal)[: len(r)] for row in rows]
    columns = [_mirrored([*c, *[None] * (3 - len(r))], normal) for c in zip(*half, strict=True)]
    mirrored = list(zip(*columns, strict=True))

    def parts(r: list[Array]) -> tuple[list[Array], Array, Array]:
        er = [_plus(*(_times(e, x) for e, x in zip(row, r, strict=False))) for row in mirrored]
        er = [there(x, r[0]) for x in er[: len(r)]]
        return er, there(_dot(r, er), r[0]), 1 / _square(r)

    def velocity(r: list[Array]) -> Vector:
        er, rer, i2 = parts(r)
        i5 = jnp.sqrt(i2) * i2 * i2
        a2 = radius * radius
        along = 2.5 * a2 * radius * i5 * (a2 * i2 - 1) * rer
        v = [along * x - a2 * a2 * radius * i5 * y for x, y in zip(r, er, strict=True)]
        return [*v, *[None] * (3 - len(r))]

    def pressure(r: list[Array]) -> Array:
        _, rer, i2 = parts(r)
        return -5 * radius**3 * jnp.sqrt(i2) * i2 * i2 * rer

    return derived(velocity, pressure, r, normal)


def reflected(
    source: _Source, height: Array, radius: Array, normal: Vector
) -> tuple[Vector, Vector]:
    """Velocity and spin of a sphere at a height above a no-slip wall."""
    z, share = height, radius * radius / 6
    v = [scaled(-1.0, _mirrored(source.velocity, normal)), scaled(-2 * z, source.slope)]
    v.append(scaled(-4 * share, source.along))
    w = [scaled(-1.0, source.spin), scaled(2.0, _cross(source.slope, normal))]
    if source.push is not None and source.push_along is not None:
        # 2 - J = 1 + 2 n n.
        twice = scaled(_times(2.0, _dot(normal, source.push)), normal)
        v += [scaled(z * z, source.push), scaled(share, total(source.push, twice))]
        v.append(scaled(2 * z * share, source.push_along))
        w.append(scaled(-z, _cross(source.push, normal)))
    return total(*v), total(*w)
