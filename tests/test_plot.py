"""Pictures: what is drawn, where and in which units."""

import re
import shutil
import subprocess
import sys
import threading
import time
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from cases import bent, scene
from matplotlib.collections import LineCollection, PatchCollection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

import jaxbeads
from jaxbeads import (
    Chain,
    NoSlipWall,
    Scene,
    average_flow_field,
    flow_field,
    plot,
    rollout,
    straight,
)
from jaxbeads.constraint import PrescribedPosition
from jaxbeads.force import Weight
from jaxbeads.plot.base import bead_colours
from jaxbeads.plot.space import Stage, camera

TIMES = np.linspace(0.0, 1.2, 7)
CHAINS = {"planar": Chain(1.0, 6), "spatial": Chain(1.0, 6), "two fibres": Chain(1.0, (4, 2))}


@cache
def trajectory(name):
    chain, dim = CHAINS[name], 3 if name == "spatial" else 2
    centre = 5.0 * np.arange(len(chain.fibres))[:, None] * np.eye(dim)[1]
    return rollout(scene(chain, dim), bent(chain, dim, centre=centre), TIMES, substeps=1)


@pytest.fixture(params=CHAINS)
def case(request):
    return trajectory(request.param), CHAINS[request.param]


def lines(ax):
    return [c for c in ax.collections if isinstance(c, LineCollection)]


def labels(ax):
    return ax.get_xlabel(), ax.get_ylabel()


def test_shapes_are_the_centre_lines(case):
    solution, chain = case
    figure = plot.shapes(solution, chain, number=3, view=plot.View(plane=(0, 1)))
    ax, bar = figure.axes
    assert labels(ax) == ("$x/L$", "$y/L$") and bar.get_ylabel() == "time $t$"
    assert ax.get_aspect() == 1  # a circle is a circle
    drawn = lines(ax)
    assert len(drawn) == 3
    position = np.asarray(solution.states.position)[..., :2] / float(chain.length[0])
    for k, line in ((0, drawn[0]), (-1, drawn[-1])):
        fibres = line.get_segments()
        assert [len(fibre) for fibre in fibres] == list(chain.fibres)
        assert np.allclose(np.concatenate(fibres), position[k], rtol=0, atol=1e-12)
    first, last = (line.get_color()[0] for line in (drawn[0], drawn[-1]))
    assert not np.allclose(first, last)


def test_no_more_shapes_than_there_are_times():
    figure = plot.shapes(trajectory("planar"), CHAINS["planar"], number=50)
    assert len(lines(figure.axes[0])) == len(TIMES)


def test_view_moves_turns_and_stretches():
    solution, chain = trajectory("spatial"), CHAINS["spatial"]
    view = plot.View(co_moving=True, plane=(0, 2), stretch=20.0)
    ax = plot.shapes(solution, chain, number=2, view=view).axes[0]
    assert labels(ax) == ("$(x - x_c)/L$", r"$20\,(z - z_c)/L$")
    final = np.asarray(solution.final.position) / float(chain.length[0])
    expected = (final - final.mean(axis=0))[:, [0, 2]] * [1.0, 20.0]
    assert np.allclose(lines(ax)[-1].get_segments()[0], expected, rtol=0, atol=1e-12)


def test_a_wall_is_drawn_where_it_is_seen():
    solution, chain = trajectory("planar"), CHAINS["planar"]
    length, low = float(chain.length[0]), float(solution.states.position[:, :, 1].min())
    wall = NoSlipWall([0.0, low - 2.0], [0.0, 3.0])

    def drawn(**options):
        ax = plot.shapes(solution, chain, view=plot.View(**options)).axes[0]
        return ax, [a for a in ax.get_children() if isinstance(a, Polygon)]

    ax, (behind,) = drawn(domain=wall)
    x, y = behind.get_xy().T
    assert abs(y.max() - (low - 2.0) / length) < 1e-12 and ax.get_ylim()[0] < y.max()
    assert x.min() < ax.get_xlim()[0] and ax.get_xlim()[1] < x.max() and y.min() < ax.get_ylim()[0]
    _, (stretched,) = drawn(domain=wall, stretch=20.0)
    assert abs(stretched.get_xy()[:, 1].max() - 20 * y.max()) < 1e-9
    assert not drawn()[1]
    # It follows the fibre along the wall alone.
    along, (beside,) = drawn(domain=wall, co_moving=True)
    assert abs(beside.get_xy()[:, 1].max() - y.max()) < 1e-12
    assert (along.get_xlabel(), along.get_ylabel()) == ("$(x - x_c)/L$", "$y/L$")
    far, (_,) = drawn(domain=NoSlipWall([0.0, -1000.0], [0.0, 1.0]))
    assert far.get_ylim()[0] > -5  # the fibre is what is to be seen


def test_a_wall_in_space_is_seen_from_the_side_only():
    solution, chain = trajectory("spatial"), CHAINS["spatial"]
    floor = NoSlipWall([0.0, 0.0, -9.0], [0.0, 0.0, 1.0])
    for plane, seen in (((0, 2), 1), ((0, 1), 0)):
        ax = plot.shapes(solution, chain, view=plot.View(plane=plane, domain=floor)).axes[0]
        assert sum(isinstance(a, Polygon) for a in ax.get_children()) == seen


def test_observable_draws_the_values():
    values = np.sin(TIMES)
    figure = plot.observable(TIMES, values, "angle [rad]")
    (ax,) = figure.axes
    (line,) = ax.lines
    assert labels(ax) == ("time $t$", "angle [rad]")
    assert np.array_equal(line.get_xdata(), TIMES) and np.array_equal(line.get_ydata(), values)
    ax = plot.observable(TIMES, values, "angle", time_label=r"$\dot\gamma t$").axes[0]
    assert ax.get_xlabel() == r"$\dot\gamma t$"


@pytest.mark.parametrize("columns", [1, 9, 14])
def test_columns_of_an_observable_are_told_apart(columns):
    values = np.sin(TIMES[:, None] * np.arange(1, columns + 1))
    figure = plot.observable(TIMES, values, "tension")
    ax = figure.axes[0]
    assert np.array_equal([line.get_ydata() for line in ax.lines], values.T)
    assert len({str(line.get_color()) for line in ax.lines}) == columns
    assert len(figure.axes) == (2 if columns > 10 else 1)
    texts = [text.get_text() for text in ax.get_legend().get_texts()] if columns == 9 else []
    assert texts == [str(k) for k in range(columns)] if columns == 9 else ax.get_legend() is None
    with pytest.raises(
        ValueError, match=r"`values` must have the shape .* with 7 times, but it is"
    ):
        plot.observable(TIMES, values[1:], "tension")


def curvature(position, length):
    """Independent of `observables`: sine of the turning angle over the bond length."""
    bond = np.diff(position, axis=1)
    before, after = bond[:, :-1], bond[:, 1:]
    if position.shape[2] == 2:
        sine = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    else:
        sine = np.linalg.norm(np.cross(before, after), axis=-1)
    sizes = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    return sine / sizes / 2.0 * length


def test_kymograph_shows_curvature_times_length(case):
    solution, chain = case
    beads, dim = chain.fibres[0], solution.states.position.shape[2]
    figure = plot.kymograph(solution, chain)
    ax, bar = figure.axes
    assert labels(ax) == ("time $t$", "arclength $s/L$")
    assert bar.get_ylabel() == r"curvature $\kappa L$"
    (image,) = (c for c in ax.collections if isinstance(c, QuadMesh))
    values = np.asarray(image.get_array()).reshape(beads - 2, len(TIMES))
    position = np.asarray(solution.states.position)[:, :beads]
    expected = curvature(position, 2.0 * beads)
    assert np.abs(expected).max() > 0.1
    assert np.allclose(values, expected.T, rtol=0, atol=1e-12)
    # White is straight in the plane; in space the curvature has no sign.
    low, high = image.get_clim()
    assert high == np.abs(values).max() and low == (-high if dim == 2 else 0.0)


@pytest.mark.parametrize(
    "draw",
    [
        lambda solution, chain, axes: plot.shapes(solution, chain, axes=axes),
        lambda solution, chain, axes: plot.observable(TIMES, TIMES, "$t$", axes=axes),
        lambda solution, chain, axes: plot.kymograph(solution, chain, axes=axes),
    ],
    ids=["shapes", "observable", "kymograph"],
)
def test_into_axes_of_ones_own_and_to_a_file(draw, case, tmp_path):
    solution, chain = case
    figure = Figure()
    axes = figure.add_subplot(2, 1, 1)
    assert draw(solution, chain, axes) is figure
    assert axes.get_xlabel() and axes.has_data()
    figure.savefig(tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as image:
        assert image.size == (640, 480)


def test_flow_shows_speed_and_beads():
    solution, chain = trajectory("spatial"), CHAINS["spatial"]
    model, final, length = scene(chain, 3), solution.final, float(chain.length[0])
    field = flow_field(1.2, final, model)
    figure = plot.flow(field, chain, plane=(0, 2), level=0.1, margin=0.3, number=20)
    ax, bar = figure.axes
    assert labels(ax) == ("$x/L$", "$z/L$") and bar.get_ylabel() == "speed $|u|$"
    (image,) = (c for c in ax.collections if isinstance(c, QuadMesh))
    points = np.asarray(image.get_coordinates())
    x = np.stack([points[..., 0], np.full(points.shape[:2], 0.1), points[..., 1]], axis=-1)
    assert max(points.shape[:2]) == 20
    speed = np.linalg.norm(field(x * length), axis=-1)
    assert np.allclose(image.get_array(), speed, rtol=1e-9, atol=0)
    assert image.get_clim()[0] == 0.0
    position = np.asarray(final.position) / length
    rings, discs = (c for c in ax.collections if isinstance(c, PatchCollection))
    corners = [path.get_extents().get_points() for path in rings.get_paths()]
    assert np.allclose([c.mean(axis=0) for c in corners], position[:, [0, 2]], atol=1e-6)
    cut = np.abs(position[:, 1] - 0.1) < 1 / length
    assert len(discs.get_paths()) == cut.sum()
    assert len(lines(ax)) == 1  # streamlines
    low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
    assert np.allclose(low, position[:, [0, 2]].min(0) - 1 / length - 0.3)
    assert np.allclose(high, position[:, [0, 2]].max(0) + 1 / length + 0.3)


def test_flow_in_a_moving_frame_above_a_wall():
    solution, chain = trajectory("planar"), CHAINS["planar"]
    length, lowest = float(chain.length[0]), float(solution.final.position[:, 1].min())
    floor = NoSlipWall([0.0, lowest - 2.0], [0.0, 1.0])
    model = scene(chain, flow=False, domain=floor)
    field = flow_field(1.2, solution.final, model, co_moving=True)
    ax = plot.flow(field, chain, number=20).axes[0]
    assert labels(ax) == ("$(x - x_c)/L$", "$(y - y_c)/L$")
    (image,) = (c for c in ax.collections if isinstance(c, QuadMesh))
    y = image.get_coordinates()[..., 1] * length + float(solution.final.position[:, 1].mean())
    nothing = np.ma.getmaskarray(np.ma.masked_invalid(image.get_array()))
    assert np.array_equal(nothing, y < lowest - 2.0) and nothing.any()
    # A mean over a run: outlines alone.
    mean = average_flow_field(
        jax.tree.map(lambda x: x[:2] if np.ndim(x) else x, solution), scene(chain)
    )
    ax = plot.flow(mean, chain, number=10, axes=Figure().add_subplot()).axes[0]
    rings, discs = (c for c in ax.collections if isinstance(c, PatchCollection))
    assert len(rings.get_paths()) == chain.beads and not discs.get_paths()


def test_a_flow_that_cannot_be_drawn():
    solution, chain = trajectory("planar"), CHAINS["planar"]
    field = flow_field(1.2, solution.final, scene(chain))
    with pytest.raises(ValueError, match="`plane` must name two of the 3 coordinates, but it is"):
        plot.flow(field, chain, plane=(0, 3))
    with pytest.raises(ValueError, match="`chain` must have the field's 6 beads, but it has 5"):
        plot.flow(field, Chain(1.0, 5))


@pytest.mark.parametrize("frames, written", [(4, 4), (1, 1), (90, len(TIMES))])
def test_movie_has_the_frames_asked_for(frames, written, case, tmp_path):
    solution, chain = case
    path = plot.movie(solution, chain, str(tmp_path / "movie.gif"), frames=frames, seconds=2.0)
    assert path == tmp_path / "movie.gif"
    with Image.open(path) as movie:
        assert movie.format == "GIF" and getattr(movie, "n_frames", 1) == written
        if written > 1:
            assert abs(movie.info["duration"] * written - 2000) < 10 * written  # in 1/100 s


def test_movie_shows_whole_beads_to_scale(tmp_path):
    # A row of 6 touching beads is 6 times as long as high, and fills pi/4 of that rectangle.
    chain = Chain(1.0, 6)
    state = straight(chain, [1.0, 0.0])
    still = eqx.tree_at(lambda s: s.states.position, trajectory("planar"), state.position[None])
    path = plot.movie(still, chain, tmp_path / "still.gif", frames=1)
    with Image.open(path) as movie:
        pixels = np.asarray(movie.convert("RGB")).astype(int)
    coloured = np.ptp(pixels, axis=2) > 40  # letters and axes are grey
    width, height = (np.ptp(np.nonzero(coloured.any(axis=k))[0]) + 1 for k in (0, 1))
    assert abs(width / height - 6) < 0.2
    assert abs(coloured.sum() / (width * height) - np.pi / 4) < 0.03


def spheres(centres):
    """A solution of one time, and its chain: spheres at centres of which the length is one."""
    centres = np.asarray(centres, float)
    chain = Chain(0.5, (1,) * len(centres))
    like = jax.tree.map(lambda x: x[:1] if np.ndim(x) else x, trajectory("planar"))
    return eqx.tree_at(lambda s: s.states.position, like, jax.numpy.asarray(centres[None])), chain


def stage(centres, radius=0.5, width=200, **view):
    centres = np.asarray(centres, float)
    made = Stage(plot.View(**view), centres, radius, 1.0)
    made.resize(made.low, made.high, width)
    return made


RED, BLUE = [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]


def coloured(picture):
    """Points that are reddish, and bluish."""
    red, _, blue = np.moveaxis(picture.astype(int), -1, 0)
    return red - blue > 40, blue - red > 40


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize("overlap", [0.0, 0.6])
def test_a_nearer_bead_covers_a_farther_one(order, overlap):
    # Looked at along x from in front: the red one is nearer; also where they overlap in space.
    centres = np.array([[1.0 - overlap, 0.0, 0.0], [0.0, 0.3, 0.0]])
    made = stage(centres, azimuth=0.0, elevation=0.0)
    colours = np.array([RED, BLUE])
    order = list(order)
    red, blue = coloured(made.paint(centres[order], np.full(2, 0.5), colours[order]))
    whole = np.pi / 4 / made.step**2
    assert abs(red.sum() / whole - 1) < (0.05 if not overlap else 0.2)
    assert 0.2 < blue.sum() / whole < 0.6
    picture = made.paint(centres, np.full(2, 0.5), colours)
    assert np.array_equal(picture, made.paint(centres[::-1], np.full(2, 0.5), colours[::-1]))
    # From behind the other one is whole.
    behind = stage(centres, azimuth=180.0, elevation=0.0)
    red, blue = coloured(behind.paint(centres, np.full(2, 0.5), colours))
    assert blue.sum() > red.sum()


def test_spheres_are_round_to_scale_and_where_the_camera_sees_them():
    centres = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 3.0]])
    made = stage(centres, width=400, azimuth=-90.0, elevation=0.0)
    assert np.allclose(made.camera, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    radii = np.array([0.5, 0.25])
    red, blue = coloured(made.paint(centres, radii, np.array([RED, BLUE])))
    for mask, centre, radius in zip((red, blue), centres, radii, strict=True):
        rows, columns = np.nonzero(mask)
        at = made.low + made.step * (np.array([columns.mean(), rows.mean()]) + 0.5)
        assert np.allclose(at, centre[[0, 2]], rtol=0, atol=2 * made.step)
        for side in (rows, columns):
            assert abs(np.ptp(side) + 1 - 2 * radius / made.step) <= 2


def test_the_camera_looks_across_the_motion_and_gravity_points_down():
    along = np.linspace(0, 1, 20)[:, None] * [1.0, 2.0, 0.0]
    seen = np.ptp(along @ camera(plot.View(), along, np.array([0.0, 0.0, 1.0]))[0])
    assert abs(seen / np.sqrt(5) - np.cos(np.radians(25))) < 1e-9
    heavy = Scene(Chain(1.0, 2), 1.0, forces=[Weight([0.0, -2.0, 0.0])])
    view = plot.View.of(heavy)
    assert view.up == (0.0, 1.0, 0.0) and view.co_moving
    up = camera(view, along, np.array(view.up)) @ np.array([0.0, 1.0, 0.0])
    assert abs(up[0]) < 1e-12 and up[1] > 0.9 and up[2] > 0
    floor = NoSlipWall([0.0, 0.0, -1.0], [0.0, 0.0, 1.0])
    for stays in ({"domain": floor}, {"constraints": [PrescribedPosition()]}):
        assert not plot.View.of(Scene(Chain(1.0, 2), 1.0, **stays)).co_moving
    assert plot.View.of(heavy, co_moving=False, up=None).up is None


def test_a_shape_that_comes_again_is_drawn_once():
    solution, chain = trajectory("spatial"), CHAINS["spatial"]
    there = np.asarray(solution.states.position)
    back = np.concatenate([there, there[::-1]])
    turned = eqx.tree_at(
        lambda s: (s.ts, s.states.position),
        solution,
        (jax.numpy.arange(float(len(back))), jax.numpy.asarray(back)),
    )
    picture = np.asarray(plot.shapes(turned, chain).axes[0].images[0].get_array()).astype(int)
    red, blue = picture[..., 0], picture[..., 2]
    assert np.any(red - blue > 60)  # the last, in yellow
    assert not np.any((blue - picture[..., 1] > 60) & (red > 60))  # not the first, in violet


def falling(chain, depth, dim=3, times=21):
    """A straight fibre that falls and does not bend, by a depth over its length."""
    start = np.asarray(straight(chain, np.eye(dim)[0]).position)
    ts = np.linspace(0.0, 2.0, times)
    down = -depth * float(chain.length[0]) * ts[:, None, None] / 2 * np.eye(dim)[-1]
    like = trajectory("planar")
    return eqx.tree_at(
        lambda s: (s.ts, s.states.position),
        like,
        (jax.numpy.asarray(ts), jax.numpy.asarray(start + down)),
    )


def marks(figure):
    return np.array([line.get_ydata()[0] for line in figure.axes[1].lines[::2]])


@pytest.mark.parametrize("co_moving", [False, True])
@pytest.mark.parametrize("depth", [0.25, 5.0])
def test_several_shapes_of_a_fibre_that_falls(depth, co_moving):
    # Seen where they are: moving with the centre they would all be one.
    chain = CHAINS["spatial"]
    figure = plot.shapes(falling(chain, depth), chain, view=plot.View(co_moving=co_moving))
    times = marks(figure)
    assert len(times) >= 3 and times[-1] == 2.0 and np.ptp(np.diff(times)) < 0.25
    assert "moving" not in figure.axes[0].get_xlabel()
    if depth > 1:
        assert len(times) == 6
    still = plot.shapes(falling(chain, 0.0), chain, view=plot.View(co_moving=co_moving))
    assert np.array_equal(marks(still), [2.0])


@pytest.mark.parametrize("wall", [False, True])
def test_a_floor_below_the_beads_has_their_shadows(wall):
    domain = NoSlipWall([0.0, 0.0, -1.5], [0.0, 0.0, 1.0])
    made = stage([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], **({"domain": domain} if wall else {}))
    assert abs(made.floor.level + 1.5) < 1e-12 if wall else made.floor.level < -0.5
    centres = np.zeros((1, 3))
    lit = made.paint(centres, np.array([0.5]), np.array([RED])).mean(axis=2)
    foot = (made.camera @ [0.0, 0.0, made.floor.level])[:2]
    column, row = ((foot - made.low) / made.step).astype(int)
    away = (made.camera @ [1.6, 0.0, made.floor.level])[:2]
    other = ((away - made.low) / made.step).astype(int)
    if wall:  # else the bead itself hides it
        assert lit[row, column] < 0.8 * lit[other[1], other[0]]
    assert lit[other[1], other[0]] < 250 and lit[-1, 0] == 255
    above = NoSlipWall([0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    covered = stage([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]], domain=above)
    assert not covered.floor.solid and covered.floor.level < -0.5 and covered.from_above


def test_fibres_are_told_apart_by_colour():
    one, several = Chain(1.0, 6), Chain(1.0, (3, 2, 1))
    each = bead_colours(several)
    assert len(np.unique(each, axis=0)) == 3 and np.array_equal(each[0], each[2])
    assert len(np.unique(bead_colours(one), axis=0)) == 6
    solution, chain = spheres([[0, 0, 0], [2, 0, 0]])
    picture = np.asarray(plot.shapes(solution, chain).axes[0].images[0].get_array()).astype(int)
    left, right = (half[np.ptp(half, axis=2) > 60] for half in np.array_split(picture, 2, axis=1))
    assert left[:, 2].mean() > left[:, 0].mean() and right[:, 2].mean() < right[:, 0].mean()


@pytest.mark.parametrize("name", ["planar", "spatial"])
def test_pictures_and_movies_fill_their_frames(name, tmp_path):
    solution, chain = trajectory(name), CHAINS[name]
    path = plot.movie(solution, chain, tmp_path / "movie.gif", frames=3)
    with Image.open(path) as movie:
        width, height = movie.size
        pixels = np.asarray(movie.convert("RGB")).astype(int)
    assert 900 <= width <= 1200 and height < 900 and path.stat().st_size < 2e6
    inked = pixels.mean(axis=2) < 252
    assert pixels[0, 0].min() == 255  # paper is white
    filled = [(np.ptp(np.nonzero(inked.any(axis=k))[0]) + 1) / (width, height)[k] for k in (0, 1)]
    assert max(filled) > 0.9 and min(filled) > 0.6
    # Still pictures: as wide over high as what they show, and a bar.
    figure = plot.shapes(solution, chain)
    figure.savefig(tmp_path / "shapes.png")
    with Image.open(tmp_path / "shapes.png") as image:
        inked = np.asarray(image.convert("L")) < 252
    filled = [(np.ptp(np.nonzero(inked.any(axis=k))[0]) + 1) / inked.shape[1 - k] for k in (0, 1)]
    assert min(filled) > 0.85


def test_a_movie_as_mp4(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    paths = [tmp_path / "a.gif", tmp_path / "a.mp4"]
    written = plot.movies(trajectory("spatial"), CHAINS["spatial"], paths, frames=3)
    assert written == paths and b"ftyp" in paths[1].read_bytes()[:16]
    with pytest.raises(ValueError, match="`path` must be a file that can be written"):
        plot.movie(trajectory("planar"), CHAINS["planar"], tmp_path / "no" / "a.mp4", frames=1)


def test_a_page_holds_all_that_it_needs(case, tmp_path):
    pytest.importorskip("k3d")
    solution, chain = case
    path = plot.html(solution, chain, tmp_path / "page.html", frames=4)
    text = path.read_text(encoding="utf-8")
    assert path.stat().st_size < 4e6 and "<html" in text
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", text)
    single = jax.tree.map(lambda x: x[:1] if np.ndim(x) else x, solution)
    assert plot.html(single, chain, tmp_path / "still.html").stat().st_size > 1000
    with pytest.raises(ValueError, match=r"`path` must end in \.html"):
        plot.html(solution, chain, tmp_path / "page.htm")
    with pytest.raises(ValueError, match="`path` must be a file that can be written"):
        plot.html(solution, chain, tmp_path / "no" / "page.html")


@pytest.fixture
def pages(monkeypatch):
    """The plots of `k3d` that are made."""
    k3d = pytest.importorskip("k3d")
    made, plain = [], k3d.plot
    monkeypatch.setattr(k3d, "plot", lambda **options: made.append(plain(**options)) or made[-1])
    return made


@pytest.mark.parametrize("co_moving", [False, True])
@pytest.mark.parametrize("depth", [0.0, 1.0, 40.0])
@pytest.mark.parametrize("dim, beads", [(2, 6), (3, 6), (3, 1)])
def test_a_page_shows_all_beads_as_it_opens(dim, beads, depth, co_moving, pages, tmp_path):
    chain = Chain(1.0, beads)
    solution = falling(chain, depth, dim)
    plot.html(solution, chain, tmp_path / "a.html", view=plot.View(co_moving=co_moving))
    (page,) = pages
    assert not page.grid_visible and len(page.objects) == 2
    centres = np.array(list(page.objects[0].positions.values()), float).reshape(-1, 3)
    low, high = page.objects[1].positions  # without which k3d would cut off what moves far
    assert np.all(low < centres) and np.all(centres < high)
    place, target, up = np.reshape(page.camera, (3, 3))
    ahead = (target - place) / np.linalg.norm(target - place)
    right = np.cross(ahead, up)
    assert abs(np.linalg.norm(right) - 1) < 1e-9
    # Points of the spheres' surfaces, in a window of 6 to 5.
    way = np.random.default_rng(0).normal(size=(300, 3))
    way *= float(page.objects[0].point_sizes[0]) / 2 / np.linalg.norm(way, axis=1, keepdims=True)
    off = (centres[:, None] + way).reshape(-1, 3) - place
    deep = off @ ahead
    half = np.tan(np.radians(page.camera_fov / 2))
    across, high = (np.abs(off @ axis / deep) / half for axis in (right, up))
    assert deep.min() > 0 and across.max() < 1.2 * 0.95 and high.max() < 0.95
    assert across.max() > 1.2 * 0.8 or high.max() > 0.8  # nor is it far away


@pytest.mark.parametrize("dim", [2, 3])
def test_a_page_shows_the_wall(dim, pages, tmp_path):
    chain = CHAINS["spatial"]
    solution, level = falling(chain, 0.5, dim), -8.0
    wall = NoSlipWall(level * np.eye(dim)[-1], 3.0 * np.eye(dim)[-1])
    for co_moving in (False, True):
        view = plot.View(domain=wall, co_moving=co_moving)
        plot.html(solution, chain, tmp_path / "a.html", view=view)
    seen, moving = pages
    # What moves with the centre moves along the wall alone.
    for page in (seen, moving):
        height = page.objects[2].vertices[:, dim - 1]
        assert np.allclose(height, level / float(chain.length[0]), atol=1e-6)
    fixed, followed = (
        np.array(list(page.objects[0].positions.values())).reshape(-1, chain.beads, 3)
        for page in pages
    )
    assert np.allclose(fixed[..., dim - 1], followed[..., dim - 1], atol=1e-6)
    assert np.abs(np.delete(followed, dim - 1, axis=2).mean(axis=1)).max() < 1e-6
    corners = seen.objects[2].vertices
    assert np.allclose(corners[:, dim - 1], level / float(chain.length[0]), atol=1e-6)
    flat = np.delete(corners, dim - 1, axis=1)
    assert np.allclose(np.linalg.norm(flat - np.roll(flat, 1, axis=0), axis=1), np.ptp(flat))
    places = np.array(list(seen.objects[0].positions.values())).reshape(-1, 3)
    places = np.delete(places, dim - 1, axis=1)
    assert np.all(flat.min(0) < places.min(0)) and np.all(places.max(0) < flat.max(0))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spatial", "two fibres"])
def test_a_browser_shows_the_page(name, tmp_path):
    # Chromium draws it by its own software, without a display and a network.
    pytest.importorskip("k3d")
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip("there is no Chromium here")
    solution, chain = trajectory(name), CHAINS[name]
    page = plot.html(solution, chain, tmp_path / "page.html", frames=2)
    colours = np.unique(bead_colours(chain), axis=0)
    for seconds in (4, 16, 64):  # a busy machine draws late
        shares = drawn(browser, page, seconds, colours)
        if min(shares) > 0.005:
            break
    assert len(shares) == len(colours) and min(shares) > 0.005, shares


def drawn(browser, page, seconds, colours):
    """Shares of a page's picture, after some seconds, that have the colours, light or dark."""
    frame = f'<img src="/late"><iframe src="/{page.name}" style="position:fixed;inset:0;border:0"'
    texts = {"/": f'{frame} width="600" height="500">'.encode(), f"/{page.name}": page.read_bytes()}

    class Answers(BaseHTTPRequestHandler):
        def do_GET(self):
            if self.path == "/late":  # the browser takes its picture once it has all
                time.sleep(seconds)
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(texts.get(self.path, b""))

        def log_message(self, *_):
            pass

    picture = page.with_suffix(".png")
    options = "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader"
    command = [browser, *options.split(), f"--user-data-dir={page.parent / 'user'}"]
    command += ["--window-size=600,500", f"--screenshot={picture}"]
    with ThreadingHTTPServer(("127.0.0.1", 0), Answers) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        place = f"http://127.0.0.1:{server.server_port}/"
        subprocess.run([*command, place], capture_output=True, timeout=180, check=True)
        server.shutdown()
    seen = np.asarray(Image.open(picture).convert("RGB"), float)
    seen /= np.linalg.norm(seen, axis=2, keepdims=True) + 1e-9
    return [np.mean(seen @ (c / np.linalg.norm(c)) > 0.99) for c in colours]


def test_a_page_without_what_makes_it(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "k3d", None)
    with pytest.raises(ValueError, match="needs the package k3d, which is not installed"):
        plot.html(trajectory("planar"), CHAINS["planar"], tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "call, says",
    [
        (lambda s, c, d: plot.movie(s, c, d / "none" / "a.gif", frames=2), "No such file or dir"),
        (lambda s, c, d: plot.movie(s, c, d / "a.mp4"), "in .gif where imageio-ffmpeg is not inst"),
        (lambda s, c, d: plot.movie(s, c, d / "a.avi"), "`path` must end in .gif or .mp4, but it"),
        (lambda s, c, d: plot.movie(s, c, d / "a.gif", frames=0), "`frames` must be at least 1"),
        (lambda s, c, d: plot.shapes(s, c, number=0), "`number` must be at least 1"),
        (
            lambda s, c, d: plot.shapes(s, c, view=plot.View(plane=(0, 2))),
            "name two of the 2 coord",
        ),
        (
            lambda s, c, d: plot.shapes(s, c, view=plot.View(plane=(1, 1))),
            "name two of the 2 coord",
        ),
        (lambda s, c, d: plot.shapes(s, Chain(1.0, 5)), "`chain` must have the solution's 6 beads"),
        (
            lambda s, c, d: plot.shapes(trajectory("spatial"), c, view=plot.View(elevation=100.0)),
            "`elevation` must lie between",
        ),
        (
            lambda s, c, d: plot.shapes(trajectory("spatial"), c, view=plot.View(stretch=2.0)),
            "`stretch` must be 1 in space",
        ),
        (
            lambda s, c, d: plot.shapes(
                trajectory("spatial"), c, view=plot.View(up=[0.0, 0.0, 0.0])
            ),
            "`up` must be a direction in space",
        ),
        (lambda s, c, d: plot.kymograph(s, Chain(1.0, 5)), "`chain` must have the solution's 6"),
        (
            lambda s, c, d: plot.kymograph(s, Chain(1.0, (2, 4))),
            "at least three beads in its first",
        ),
    ],
)
def test_what_cannot_be_drawn(call, says, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxbeads.plot.animation.can_encode", lambda: False)
    with pytest.raises(ValueError, match=says) as caught:
        call(trajectory("planar"), CHAINS["planar"], tmp_path)
    assert str(caught.value).startswith("Argument `") and "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_single_state_can_be_drawn(case, tmp_path):
    # As in the solution of a run that broke down in its first step.
    solution, chain = case
    single = jax.tree.map(lambda x: x[:1] if np.ndim(x) else x, solution)
    assert len(lines(plot.shapes(single, chain, view=plot.View(plane=(0, 1))).axes[0])) == 1
    assert len(plot.shapes(single, chain).axes) == 2
    plot.kymograph(single, chain).savefig(tmp_path / "kymograph.png")
    plot.movie(single, chain, tmp_path / "movie.gif")


def test_matplotlib_is_imported_on_demand():
    code = "import sys, jaxbeads; print('matplotlib' in sys.modules); import jaxbeads.plot"
    root = Path(jaxbeads.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False"]
