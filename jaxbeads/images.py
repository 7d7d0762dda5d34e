"""Images of spheres behind a no-slip wall: what it adds to the mobility.

Let v, p be the flow of the mirrored source behind the plane, w the component of v along the plane's
normal n, z the height above the plane and J the mirror, J x = x - 2 n (n.x). Lorentz's reflection

    u = -J v - 2 z grad w + (z^2/mu) grad p

is a Stokes flow that cancels the flow of the source itself on the wall. Its mean over the surface of a
sphere of radius a is (1 + a^2/6 lap) u at the centre, with lap u = (2 - J) grad p/mu - 4 (n.grad) grad w
+ 2 z (n.grad) grad p/mu, and its half curl is -curl v/2 + 2 grad w x n - (z/mu) grad p x n. All that is
needed is a source's v and p with two derivatives. Those of forces and torques spread over a sphere are
worked out (`_Pairs`), those of the stresslet of a sphere in a straining flow found by differentiation.
The result is that of Swan & Brady, Phys. Fluids 19 (2007) 113306, for spheres of any radii.

Vectors are lists of components in space, of which `None` is zero.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import tensors
from .configuration import Configuration
from .domain import NoSlipWall
from .pairs import PairTensor, Signed, added, pair_sums, separations
from .state import Load, Motion, add_motions, spins

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
    there = [x for x in terms if x is not None]
    return reduce(jnp.add, there) if there else None


def _scaled(number: Component | float, vector: Vector) -> Vector:
    return [_times(number, x) for x in vector]


def _total(*vectors: Vector) -> Vector:
    return [_plus(*parts) for parts in zip(*vectors, strict=True)]


def _dot(a: Vector, b: Vector) -> Component:
    return _plus(*(_times(x, y) for x, y in zip(a, b, strict=True)))


def _cross(a: Vector, b: Vector) -> Vector:
    return [_plus(_times(a[j], b[k]), _times(-1.0, a[k], b[j])) for j, k in _AXES]


def _there(component: Component, like: Array) -> Array:
    return jnp.zeros_like(like) if component is None else component


def _square(r: Vector) -> Array:
    return reduce(jnp.add, [x * x for x in r if x is not None])


class _Source(NamedTuple):
    """The flow of a mirrored source, without 8 pi mu: v, half its curl, grad w, (n.grad) grad w, and the
    same of the pressure over the viscosity (`None` without a pressure)."""

    velocity: Vector
    spin: Vector
    slope: Vector
    along: Vector
    push: Vector | None = None
    push_along: Vector | None = None


def _mirrored(vector: Vector, normal: Vector) -> Vector:
    return _total(vector, _scaled(_times(-2.0, _dot(normal, vector)), normal))


class _Pairs(NamedTuple):
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
        velocity = _total(_scaled(of_f, f), _scaled(along, r), _scaled(up, n))
        of_r, of_n, s_across, n_across = self.force_spin
        arm = _total(_scaled(of_r, r), _scaled(of_n, n))
        turn = _plus(_times(s, s_across), _times(fn, n_across))
        return velocity, _total(_cross(f, arm), _scaled(turn, self.across))

    def by_torque(self, torque: Vector) -> tuple[Vector, Vector]:
        """The same under a torque, which a mirror turns the other way."""
        r, n = self.r, self.normal
        t = _scaled(-1.0, _mirrored(torque, n))
        q, tn = _dot(t, self.across), _dot(n, t)
        of_turn, of_m, along, up = self.torque
        velocity = _total(
            _cross(t, _total(_scaled(of_turn, r), _scaled(_times(-1.0, of_m), n))),
            _scaled(_times(q, along), r),
            _scaled(_times(q, up), n),
        )
        of_t, flat, of_r, of_across = self.torque_spin
        spin = _total(
            _scaled(of_t + flat, t),
            _scaled(_times(-1.0, tn, flat), n),
            _scaled(_times(_dot(r, t), of_r), r),
            _scaled(_times(q, of_across), self.across),
        )
        return velocity, spin


def _pairs(
    r: Vector, height: Array, normal: Vector, z: Array, radius: Array, source: Array
) -> _Pairs:
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
    return _Pairs(r, normal, _cross(r, normal), force, force_spin, torque, torque_spin)


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
        return _there(_dot(normal, velocity(r)), r[0])

    slope, slope_along = jax.jvp(slopes(across), (r,), (along,))
    push, push_along = jax.jvp(slopes(pressure), (r,), (along,))
    rows = [
        slopes(lambda r, i=i: _there(velocity(r)[i], r[0]))(r) for i in range(count)
    ]  # d v_i/d r_k

    def half(i: int, j: int) -> Component:
        return 0.5 * (rows[j][i] - rows[i][j]) if max(i, j) < count else None

    spin = [half(j, k) for j, k in _AXES]
    return _Source(
        velocity(r), spin, whole(slope), whole(slope_along), whole(push), whole(push_along)
    )


def _strained(
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
        er = [_there(x, r[0]) for x in er[: len(r)]]
        return er, _there(_dot(r, er), r[0]), 1 / _square(r)

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
    v = [_scaled(-1.0, _mirrored(source.velocity, normal)), _scaled(-2 * z, source.slope)]
    v.append(_scaled(-4 * share, source.along))
    w = [_scaled(-1.0, source.spin), _scaled(2.0, _cross(source.slope, normal))]
    if source.push is not None and source.push_along is not None:
        # 2 - J = 1 + 2 n n.
        twice = _scaled(_times(2.0, _dot(normal, source.push)), normal)
        v += [_scaled(z * z, source.push), _scaled(share, _total(source.push, twice))]
        v.append(_scaled(2 * z * share, source.push_along))
        w.append(_scaled(-z, _cross(source.push, normal)))
    return _total(*v), _total(*w)


class Spheres(NamedTuple):
    """Some spheres, lengths in units of one: positions, heights, radii."""

    position: Array
    height: Array
    radius: Array


class Wall(NamedTuple):
    """Spheres above a no-slip wall, each at least as high as its radius."""

    configuration: Configuration
    length: Array
    direction: Array
    normal: Vector
    spheres: Spheres

    share: Float[Array, " beads"]
    """By which spheres that overlap the wall are slowed, see `wall`."""

    def slowed(self, tree: Any) -> Any:
        """Loads or motions times the share of each bead."""
        return jax.tree.map(lambda x: self.share[:, None] * x, tree)

    def slowed_tables(self, tables: PairTensor) -> PairTensor:
        """The same of a mobility, from both sides."""
        pairs = self.share[:, None] * self.share[None, :]
        return jax.tree.map(lambda field: pairs * field, tables)

    def _apart(self, to: Spheres, of: Spheres) -> tuple[list[Array], Array]:
        """From the mirror images to the spheres, and that along the normal."""
        images = of.position - 2 * of.height[:, None] * self.direction[None]
        return separations(to.position, images), to.height[:, None] + of.height[None, :]

    def _components(self, velocity: Vector, spin: Vector, like: Array) -> list[Array]:
        dim = self.configuration.dim
        parts = list(velocity[:dim])
        if self.configuration.rotational:
            parts += spin[2:] if dim == 2 else spin
        return [_there(x, like) for x in parts]

    def _motion(
        self, fields: Callable[[Spheres, Spheres], list[Array]], to: Spheres | None
    ) -> Motion:
        sums, dim = pair_sums(fields, self.spheres, to), self.configuration.dim
        velocity = jnp.stack(sums[:dim], axis=-1)
        spin = jnp.stack(sums[dim:], axis=-1) if self.configuration.rotational else None
        return Motion(velocity, spin)

    def _pairs(self, to: Spheres, of: Spheres) -> _Pairs:
        r, height = self._apart(to, of)
        vector = [*r, *[None] * (3 - len(r))]
        z, a, b = to.height[:, None], to.radius[:, None], of.radius[None, :]
        return _pairs(vector, height, self.normal, z, a, b)

    def _loaded(self, pairs: _Pairs, force: Vector, torque: Vector) -> list[Array]:
        """What forces and torques on the second spheres do to the first."""
        unit = 1 / (8 * np.pi * self.configuration.viscosity * self.length)
        velocity: list[Vector] = []
        spin: list[Vector] = []
        if any(x is not None for x in force):
            v, w = pairs.by_force(_scaled(unit, force))
            velocity.append(v)
            spin.append(_scaled(1 / self.length, w))
        if any(x is not None for x in torque):
            v, w = pairs.by_torque(_scaled(unit / self.length, torque))
            velocity.append(v)
            spin.append(_scaled(1 / self.length, w))
        return self._components(_total(*velocity), _total(*spin), pairs.force[0])

    def _pushed(self, load: Load) -> Callable[[Spheres, Spheres], list[Array]]:
        """The motions of some spheres under the images of loads on others, as fields."""
        dim = self.configuration.dim

        def rows(x: Array | None) -> Vector:
            return [None] * 3 if x is None else [c[None, :] for c in x.T]

        force = rows(load.force)
        force = [*force[:dim], *[None] * (3 - dim)]
        torque = rows(load.torque)
        torque = torque if len(torque) == 3 else [None, None, *torque]
        return lambda to, of: self._loaded(self._pairs(to, of), force, torque)

    def motion(self, load: Load, to: Spheres | None = None) -> Motion:
        """What the images of loads add to M F, or to the motion of other spheres."""
        return self._motion(self._pushed(load), to)

    def gradient(
        self,
        load: Load,
        lifted: Float[Array, "shifts beads dim"],
        shares: Float[Array, "shifts beads"],
    ) -> Motion:
        """Derivatives of the motion under loads, from those of the spheres' places and shares.

        With f_ij the motion of i by the load on j, sum_j B_i f_ij B_j has the derivative
        sum_j (dB_i f_ij B_j + B_i f_ij dB_j + B_i df_ij B_j), and df_ij is found for each pair once.
        """
        here, spheres, dim = self.configuration, self.spheres, self.configuration.dim
        free = tensors.rpy_gradient(here, self.slowed(load), None, lifted)
        vectors, radii = here.scaled.pairs()
        parts = vectors, radii, self.length, here.viscosity, here.rotational
        images = self._pushed(load)(spheres, spheres)
        pairs = [a + b for a, b in zip(tensors.pushed(*parts, load), images, strict=True)]

        units = jnp.eye(dim, dtype=spheres.position.dtype)
        moved = (
            jnp.broadcast_to(units[:, None], (dim, *spheres.position.shape)),
            jnp.broadcast_to(self.direction[:, None], (dim, len(spheres.height))),
        )
        fields = self._pushed(self.slowed(load))

        def at(to: tuple[Array, Array], of: tuple[Array, Array]) -> list[Array]:
            return fields(Spheres(*to, spheres.radius), Spheres(*of, spheres.radius))

        place = spheres.position, spheres.height
        own = jax.vmap(jax.linearize(lambda x: at(x, place), place)[1])(moved)
        other = jax.vmap(jax.linearize(lambda x: at(place, x), place)[1])(moved)
        shifts = lifted / self.length
        total = tensors.as_motion(
            [
                jnp.einsum("sic,ci->si", shifts, mine.sum(axis=2))
                + jnp.einsum("sjc,cij->si", shifts, others)
                + jnp.einsum("sj,ij->si", shares, pair)
                for mine, others, pair in zip(own, other, pairs, strict=True)
            ],
            here,
        )
        still = tensors.as_motion([(pair @ self.share)[None] for pair in pairs], here)
        turned = jax.tree.map(lambda x: shares[:, :, None] * x, still)
        return add_motions(jax.vmap(self.slowed)(add_motions(free, total)), turned)

    def tables(self) -> PairTensor:
        """What they add to M, as fields."""
        dim, turns = self.configuration.dim, spins(self.configuration.dim)
        spheres, rotational = self.spheres, self.configuration.rotational
        one, none = jnp.ones((1, 1), spheres.position.dtype), [None] * 3
        pairs = self._pairs(spheres, spheres)

        def column(force: Vector, torque: Vector) -> list[Array]:
            return self._loaded(pairs, force, torque)

        def unit(k: int) -> Vector:
            return [one if j == k else None for j in range(3)]

        by_force = [column(unit(k), none) for k in range(dim)]
        tt = tuple(tuple(c[i] for c in by_force) for i in range(dim))
        if not rotational:
            return PairTensor(tt)
        by_torque = [column(none, unit(k)) for k in (range(3) if dim == 3 else (2,))]
        tr = tuple(tuple(Signed(c[i]) for c in by_torque) for i in range(dim))
        rt = tuple(tuple(Signed(c[dim + i]) for c in by_force) for i in range(turns))
        return PairTensor(
            tt, tr, rt, tuple(tuple(c[dim + i] for c in by_torque) for i in range(turns))
        )

    def disturbance(
        self, strain_rate: Float[Array, "*beads dim dim"], to: Spheres | None = None
    ) -> Motion:
        """What the images of the spheres' stresslets add to C : E, or to the motion of others."""
        rows = strain_rate if strain_rate.ndim == 2 else strain_rate[None]
        dim = self.configuration.dim

        def fields(to: Spheres, of: Spheres) -> list[Array]:
            r, height = self._apart(to, of)
            e = [[rows[..., i, j] for j in range(dim)] for i in range(dim)]
            source = _strained(r, self.normal, e, of.radius[None, :] + 0 * height)
            v, w = reflected(source, to.height[:, None], to.radius[:, None], self.normal)
            return self._components(_scaled(self.length, v), w, height)

        return self._motion(fields, to)


def wall(configuration: Configuration) -> Wall:
    """The images behind a no-slip wall, and the configuration that has them.

    They are those of spheres above the wall. One that overlaps it is lifted until it touches, and loads
    on it and its motion are multiplied by its height over its radius, at least 0: with B the diagonal of
    these shares, B M B is as positive as M, and no bead moves through the wall.
    """
    domain = configuration.domain
    if not isinstance(domain, NoSlipWall):
        raise ValueError("Argument `configuration` must be that of a `NoSlipWall`, but it is not.")
    height, normal = domain.height(configuration.position), domain.direction
    lift = jnp.maximum(configuration.radius - height, 0.0)
    share = jnp.clip(height / configuration.radius, 0.0, 1.0)
    lifted = configuration.at(configuration.position + lift[:, None] * normal[None])
    scaled = lifted.scaled
    radius = 1.0 if scaled.radius is None else scaled.radius
    radii = jnp.broadcast_to(jnp.asarray(radius, height.dtype), height.shape)
    components = [*normal, *[None] * (3 - len(normal))]
    spheres = Spheres(scaled.position, (height + lift) / scaled.length, radii)
    return Wall(lifted, scaled.length, normal, components, spheres, share)


def motion(configuration: Configuration, load: Load) -> Motion:
    """M F near a no-slip wall."""
    here = wall(configuration)
    load = here.slowed(load)
    free = tensors.rpy_motion(here.configuration, load)
    return here.slowed(add_motions(free, here.motion(load)))


def disturbance(
    configuration: Configuration, strain_rate: Float[Array, "*beads dim dim"]
) -> Motion:
    """C : E near a no-slip wall."""
    here = wall(configuration)
    free = tensors.shear_disturbance(here.configuration, strain_rate)
    return here.slowed(add_motions(free, here.disturbance(strain_rate)))


def gradient(
    configuration: Configuration, load: Load, shifts: Float[Array, "shifts beads dim"]
) -> Motion:
    """Derivatives of M F along shifts of the positions, with F held, see `tensors.rpy_gradient`."""

    def placed(position: Array) -> tuple[Array, Array]:
        there = wall(configuration.at(position))
        return there.configuration.position, there.share

    _, push = jax.linearize(placed, configuration.position)
    return wall(configuration).gradient(load, *jax.vmap(push)(shifts))


def tables(configuration: Configuration) -> PairTensor:
    """M near a no-slip wall, as fields."""
    here = wall(configuration)
    return here.slowed_tables(added(tensors.rpy(here.configuration), here.tables()))
