# ---
# jupyter:
#   jupytext:
#     cell_metadata_filter: -all
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # The best stroke of three spheres
#
# Three spheres in a row, linked by two arms whose lengths are prescribed,
# $$ \ell_1 = D + s_1 \cos 2 \pi t, \qquad \ell_2 = D + s_2 \cos(2 \pi t - \varphi), $$
# swim along their line (Najafi and Golestanian, 2004). For spheres of radius $a \ll D$ and small
# strokes the displacement in a cycle is $\frac{7}{12} \frac{a}{D^2}$ times the area $\pi s_1 s_2
# \sin \varphi$ that the stroke encloses in the plane of the arms. A quarter of a period between the
# arms, $\varphi = 90°$, encloses the largest area. Is it the best stroke?
#
# Asked here: which strokes $s_1$, $s_2$ and which phase $\varphi$ give the largest displacement in a
# cycle at a given mean power? Gradients find them from an unequal start. For small strokes a 2 x 2
# eigenproblem knows the answer; for large ones a search without gradients on quadratures does. Both
# are written here in numpy and share nothing with the simulator. Units: $a$, the viscosity and the
# period are 1.

# %%
import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from scipy.linalg import eigh
from scipy.optimize import minimize

import jaxbeads as jb
from jaxbeads import scenes
from jaxbeads.constraint import PrescribedLengths

jax.config.update("jax_enable_x64", True)
checks = []  # rows of the table at the end: quantity, measured, reference, allowed difference

# %% [markdown]
# ## The known answer
#
# No force acts on the swimmer as a whole, so its motion is linear in the rates of its arms. At each
# instant the centre moves at $c(\ell) \cdot \dot\ell$ and the fluid takes the power $\dot\ell \cdot
# P(\ell)\, \dot\ell$. By Stokes' theorem the displacement in a cycle is the integral of the curl,
# $\partial_1 c_2 - \partial_2 c_1$, over what the stroke encloses.
#
# For small strokes both numbers belong to the mean shape. With $z = (s_1, s_2 e^{-i \varphi})$,
# $$ \Delta = z^\dagger K z, \quad K = \frac{\pi}{2}\, \mathrm{curl}\, c
# \begin{pmatrix} 0 & i \\ -i & 0 \end{pmatrix}, \qquad \bar P = z^\dagger (2 \pi^2 P)\, z, $$
# and the largest $\Delta / \bar P$ is an eigenvalue of $K z = \lambda\, 2 \pi^2 P z$. Its vector has
# $$ \cos\varphi = -P_{12} / \sqrt{P_{11} P_{22}}, \qquad s_1 / s_2 = \sqrt{P_{22} / P_{11}} . $$
# The mobility along the line of centres is that of Rotne, Prager and Yamakawa. Derivatives of $c$
# are by a complex step, exact to rounding.


# %%
def instant(arms, radii):
    """c and P for given arm lengths; arms may be complex."""
    a, (first, second) = np.asarray(radii), arms
    apart = np.array([[1, first, first + second], [first, 1, second], [first + second, second, 1]])
    squares = a[:, None] ** 2 + a**2
    mobility = (1 - squares / (3 * apart**2)) / (4 * np.pi * apart)
    mobility[np.diag_indices(3)] = 1 / (6 * np.pi * a)
    # Forces f and the first sphere's velocity v: M f - v = what the arms add; the forces sum to zero.
    system = np.block([[mobility, -np.ones((3, 1))], [np.ones((1, 3)), np.zeros((1, 1))]])
    added = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 0.0]])
    solved = np.linalg.solve(system, added)
    return solved[3] + added[:3].mean(axis=0), added[:3].T @ solved[:3]


def curl(arms, radii):
    """Displacement over enclosed area, of a small stroke about these arm lengths."""
    step = 1e-30j * np.eye(2)
    first, second = (instant(arms + step[k], radii)[0].imag / 1e-30 for k in range(2))
    return first[1] - second[0]


def best_small_stroke(separation, radii):
    """Phase, s_1 / s_2, and displacement at given power over that of equal strokes at 90 degrees."""
    arms = np.array([separation, separation])
    moved = np.pi / 2 * curl(arms, radii) * np.array([[0, 1j], [-1j, 0]])
    power = 2 * np.pi**2 * instant(arms, radii)[1]
    values, vectors = eigh(moved, power)
    (first, second), quarter = vectors[:, -1], np.array([1, -1j])
    known = (quarter.conj() @ moved @ quarter) / (quarter.conj() @ power @ quarter)
    return np.angle(first / second), abs(first / second), values[-1] / known.real


def cycle_by_quadrature(separation, strokes, phase, radii, points=24):
    """Displacement and mean power of any stroke, by the trapezoidal rule over a period."""
    angle = 2 * np.pi * np.arange(points)[:, None] / points - np.array([0, phase])
    arms, rates = separation + strokes * np.cos(angle), -2 * np.pi * strokes * np.sin(angle)
    moved = work = 0.0
    for lengths, rate in zip(arms, rates, strict=True):
        centre, power = instant(lengths, radii)
        moved, work = moved + centre @ rate / points, work + rate @ power @ rate / points
    return moved, work


equal = np.ones(3)
for separation in (1000.0, 100.0, 10.0):
    centre, power = instant(np.full(2, separation), equal)
    phase, split, gained = best_small_stroke(separation, equal)
    print(
        f"D = {separation:6g} a: curl c over (7/12) a/D^2 "
        f"{curl(np.full(2, separation), equal) * separation**2 * 12 / 7:.5f}, P_12/P_11 "
        f"{power[0, 1] / power[0, 0]:.4f}, best phase {np.degrees(phase):.3f} deg, "
        f"s1/s2 {split:.3f}, gain {gained:.4f}"
    )

# %% [markdown]
# **The best phase is not 90 degrees, but 120.** Far apart, three equal spheres take the power
# $\frac{2}{3} 6 \pi \mu a\, (\dot\ell_1^2 + \dot\ell_1 \dot\ell_2 + \dot\ell_2^2)$. The arms share
# the middle sphere: when one shortens as the other lengthens, mostly that sphere moves, at a third of
# the power that it takes to lengthen both together. So the phase moves towards
# antiphase, until the area that is lost weighs as much as the power that is saved. At 120 degrees
# each sphere moves as far as any other, a third of a period behind its neighbour. Displacement at
# given power is $2/\sqrt{3} = 1.155$ times that of a quarter of a period.
#
# ## The swimmers
#
# Four have equal spheres, at $D/a$ from 5 to 100. Two have one sphere of twice the radius. Their
# strokes are small: the power of each is what strokes of $0.01\, D$ at 90 degrees take (0.02 in one
# case more, to see the error of the small-stroke theory). The last has $D = 6 a$ and the power of
# strokes of $0.4\, D$, beyond any small-stroke theory.

# %%
# D, radii, reference stroke over D
SWIMMERS = [
    (100.0, (1, 1, 1), 0.01),
    (100.0, (1, 1, 1), 0.02),
    (20.0, (1, 1, 1), 0.01),
    (10.0, (1, 1, 1), 0.01),
    (5.0, (1, 1, 1), 0.01),
    (10.0, (1, 1, 2), 0.01),
    (10.0, (1, 2, 1), 0.01),
    (6.0, (1, 1, 1), 0.4),
]
LARGE = len(SWIMMERS) - 1
reference = np.array(
    [cycle_by_quadrature(d, np.full(2, e * d), np.pi / 2, r) for d, r, e in SWIMMERS]
)
separations, radii, sizes = (jnp.array(x, float) for x in zip(*SWIMMERS, strict=True))
quarter = jnp.asarray(reference)  # displacement and mean power of the stroke at 90 degrees

# %% [markdown]
# ## Displacement and power as functions of the stroke
#
# Arms that are prescribed need no time steps: where the spheres are relative to one another is known
# at every instant, and so are velocity and power. `objectives.mean_over_time` and
# `objectives.mean_power` take the means over such a cycle. (A `rollout` checks that below.) Values
# to be varied: both strokes, in units of the reference stroke, and the phase; the number of the
# swimmer goes along with them, and as a whole number has no gradient.


# %%
def cycle_of(values):
    """Number of the swimmer, states over a cycle, and scene."""
    k = values["swimmer"].astype(int)
    strokes = sizes[k] * separations[k] * values["strokes"]
    arms = scenes.Arms(separations[k], strokes, jnp.stack([0.0, 1.0]) * values["phase"])
    scene = jb.Scene(jb.Chain(radii[k], 3), 1.0, constraints=[PrescribedLengths(arms)])
    ts = jnp.linspace(0.0, 1.0, 25)
    return k, jb.Solution(ts, jax.vmap(lambda t: placed(arms(t)))(ts), 0, 0), scene


def placed(arms):
    """Spheres along x, the middle one at the origin."""
    x = jnp.stack([-arms[0], 0.0 * arms[0], arms[1]])
    return jb.State(jnp.stack([x, jnp.zeros(3)], axis=1))


def forward(t, state, scene):
    """Velocity of the centre."""
    return jb.dynamics.motion(t, state, scene).velocity[:, 0].mean()


def gain(values):
    """Displacement in a cycle over that at 90 degrees."""
    k, cycle, scene = cycle_of(values)
    return jb.objectives.mean_over_time(forward, cycle, scene) / quarter[k, 0]


def excess_power(values):
    """Mean power over that at 90 degrees, less 1."""
    k, cycle, scene = cycle_of(values)
    return jb.objectives.mean_power(cycle, scene) / quarter[k, 1] - 1


# %% [markdown]
# ## Optimising
#
# All swimmers are followed side by side, from strokes in the ratio 2.6 : 1 and a phase of 46
# degrees. The power is held by the constraint. L-BFGS here searches along each direction by
# backtracking, which compiles faster than the default search.

# %%
number = len(SWIMMERS)
start = {
    "strokes": np.tile([1.3, 0.5], (number, 1)),
    "phase": np.full(number, 0.8),
    "swimmer": np.arange(float(number)),
}
best = jb.optimise(
    lambda values: -gain(values),
    start,
    constraint=excess_power,
    many=True,
    optimiser=optax.lbfgs(linesearch=optax.scale_by_backtracking_linesearch(30)),
    progress=False,
)
strokes, phases = np.asarray(best.values["strokes"]), np.asarray(best.values["phase"])
gains = -np.asarray(best.loss)
print(best.status, f"; largest violation of the power {np.max(best.violation):.1e}")

print("   D/a  radii    stroke |  phase (deg)  s1/s2    gain | small-stroke theory")
theory = []
for k, (separation, sphere, size) in enumerate(SWIMMERS):
    phase, split, small = best_small_stroke(separation, sphere)
    theory.append((phase, split, small))
    print(
        f"{separation:6g}  {sphere}  {size:4g} | {np.degrees(phases[k]):10.4f} "
        f"{strokes[k, 0] / strokes[k, 1]:9.5f} {gains[k]:8.5f} | "
        f"{np.degrees(phase):8.4f} {split:8.5f} {small:8.5f}"
    )
theory = np.array(theory)

# %% [markdown]
# Equal spheres: the strokes become equal, as the mirror image of the swimmer demands, and the phase
# goes from 120 degrees to less as $D$ falls, because spheres that drag each other along lower
# $P_{12}/P_{11}$. With a larger sphere at the end, the arm away from it makes the longer stroke. A
# larger middle sphere moves less, couples the arms less, and brings the phase nearer to 90 degrees.
#
# The theory of small strokes neglects terms of relative order $(s/D)^2$, $10^{-4}$ at $s = 0.01 D$.
# That is the difference allowed below; twice the stroke must make four times the difference.

# %%
for k in (0, 2, 3, 4, 5, 6):
    separation, sphere, size = SWIMMERS[k]
    name = f"D = {separation:g} a, radii {sphere}"
    checks.append((f"{name}: phase", phases[k], theory[k, 0], size**2))
    checks.append((f"{name}: s1/s2", strokes[k, 0] / strokes[k, 1], theory[k, 1], size**2))
    checks.append((f"{name}: gain", gains[k], theory[k, 2], size**2))
errors = np.abs(phases[:2] - theory[:2, 0])
checks.append(("difference of phase, stroke 0.02 over 0.01", errors[1] / errors[0], 4.0, 0.05))
far = best_small_stroke(1e6, equal)
checks.append(("theory, D to infinity: phase in degrees", np.degrees(far[0]), 120.0, 1e-4))
checks.append(("theory, D to infinity: gain", far[2], 2 / np.sqrt(3), 1e-6))
law = 7 / 12 / 100.0**2 * np.pi
checks.append(("a/D = stroke = 0.01: displacement over law", reference[0, 0] / law, 1.0071, 1e-4))
area = law * strokes[0].prod() * np.sin(phases[0])
checks.append(("... of the best stroke", gains[0] * reference[0, 0] / area, 1.0071, 1e-4))

# %% [markdown]
# ## A large stroke
#
# For $D = 6 a$ and the power of strokes of $0.4\, D$, the reference is a search by sequential
# quadratic programming with differences of quadratures, which knows no gradients of the simulator.


# %%
def by_quadrature(x):
    separation, sphere, size = SWIMMERS[LARGE]
    moved = cycle_by_quadrature(separation, size * separation * x[:2], x[2], sphere)
    return moved / reference[LARGE]


searched = minimize(
    lambda x: -by_quadrature(x)[0],
    [1.3, 0.5, 0.8],
    constraints={"type": "eq", "fun": lambda x: by_quadrature(x)[1] - 1},
    method="SLSQP",
    options={"ftol": 1e-13},
)
print(f"gradients:   strokes {strokes[LARGE]}, phase {np.degrees(phases[LARGE]):.5f} deg, ", end="")
print(f"gain {gains[LARGE]:.7f}")
print(f"quadratures: strokes {searched.x[:2]}, phase {np.degrees(searched.x[2]):.5f} deg, ", end="")
print(f"gain {-searched.fun:.7f}")
for name, found, known in (
    ("first stroke", strokes[LARGE, 0], searched.x[0]),
    ("second stroke", strokes[LARGE, 1], searched.x[1]),
    ("phase", phases[LARGE], searched.x[2]),
    ("gain", gains[LARGE], -searched.fun),
):
    checks.append((f"D = 6 a, large: {name}", found, known, 1e-6))
checks.append(("largest violation of the power", np.max(best.violation), 0.0, 1e-6))

# %% [markdown]
# Left: the plane of the arms at $D = 6 a$. The colour is the curl, the displacement over the area
# that is enclosed there; it is larger where arms are short. The loop at 90 degrees (dashed) and the
# best one take the same power. Middle: the best phase of small strokes against $a/D$. Right: how
# gradients come to it; every twenty steps the multiplier of the power is corrected.

# %%
figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained", dpi=110)
separation, sphere, size = SWIMMERS[LARGE]
grid = np.linspace(2.6, 9.4, 35)
field = [[curl(np.array([x, y]), sphere) for x in grid] for y in grid]
shown = axes[0].contourf(grid, grid, field, levels=12, cmap="Blues")
figure.colorbar(shown, ax=axes[0], label="displacement over area ($1/a$)")
turn = np.linspace(0, 2 * np.pi, 200)
for s, phase, style, name in (
    (np.ones(2), np.pi / 2, "k--", "90 degrees"),
    (strokes[LARGE], phases[LARGE], "#d95f02", "best"),
):
    axes[0].plot(
        separation * (1 + size * s[0] * np.cos(turn)),
        separation * (1 + size * s[1] * np.cos(turn - phase)),
        style,
        label=name,
    )
axes[0].set(xlabel=r"first arm $\ell_1/a$", ylabel=r"second arm $\ell_2/a$", aspect="equal")
axes[0].legend(loc="upper right", fontsize=8)
ratio = np.linspace(0.002, 0.25, 40)
for sphere, colour, label in (
    ((1, 1, 1), "#31688e", "equal spheres"),
    ((1, 1, 2), "#35b779", "large end sphere"),
    ((1, 2, 1), "#440154", "large middle sphere"),
):
    known = [np.degrees(best_small_stroke(1 / r, sphere)[0]) for r in ratio]
    axes[1].plot(ratio, known, color=colour, label=label)
    at = [k for k in range(LARGE) if SWIMMERS[k][1] == sphere]
    axes[1].plot([1 / SWIMMERS[k][0] for k in at], np.degrees(phases[at]), "o", color=colour)
axes[1].plot([], [], "o", color="0.4", label="by gradients")
axes[1].axhline(120, color="0.7", linewidth=1, zorder=0)
axes[1].set(xlabel="$a/D$", ylabel="best phase (degrees)", ylim=(90, 140))
axes[1].legend(frameon=False, fontsize=8, loc="upper right", ncols=2)
history = best.history
away = np.abs(history.loss[:, LARGE] - searched.fun)
axes[2].semilogy(away, color="#31688e", label="gain, from the known one")
axes[2].semilogy(history.violation[:, LARGE], color="#d95f02", label="power, from the given one")
axes[2].set(xlabel="step", ylabel="relative difference", ylim=(1e-9, 10))
axes[2].set_title("$D = 6a$, large stroke", fontsize=10)
axes[2].legend(frameon=False)
plt.show()

# %% [markdown]
# ## The trajectory
#
# The best strokes are now followed in time, by a `rollout` with equal steps of Tsitouras' method.
# Displacement and power must be those of the cycles above, and so must their gradients, which go
# through every step.


# %%
def followed(values):
    """Displacement over power of a trajectory, both over those at 90 degrees."""
    k, cycle, scene = cycle_of(values)
    first = jax.tree.map(lambda x: x[0], cycle.states)
    run = jb.rollout(scene, first, cycle.ts, solver=diffrax.Tsit5(), substeps=1)
    moved = jb.objectives.displacement(run)[0] / quarter[k, 0]
    return moved / (jb.objectives.mean_power(run, scene) / quarter[k, 1])


differentiated = jax.jit(jax.value_and_grad(followed))
here = {name: value[LARGE] for name, value in best.values.items()}
value, _ = differentiated(here)
checks.append(("rollout, best stroke: gain", value, gains[LARGE], 1e-6))
here = {name: jnp.asarray(value[LARGE]) for name, value in start.items()}
value, slope = differentiated(here)
slope = np.append(slope["strokes"], slope["phase"])
x, step = np.append(here["strokes"], here["phase"]), 1e-4


def by_area(x):
    moved, power = by_quadrature(x)
    return moved / power


for k, name in enumerate(("first stroke", "second stroke", "phase")):
    move = step * np.eye(3)[k]
    known = (by_area(x + move) - by_area(x - move)) / (2 * step)
    checks.append((f"rollout, start: derivative by {name}", slope[k], known, 1e-6))

# %% [markdown]
# ## Check

# %%
print(f"{'quantity':46s} {'measured':>12s} {'reference':>10s} {'difference':>11s} {'allowed':>8s}")
for name, measured, known, allowed in checks:
    off = abs(float(measured) - float(known))
    print(f"{name:46s} {float(measured):12.7g} {float(known):10.7g} {off:11.1e} {allowed:8.0e}")
for name, measured, known, allowed in checks:
    assert abs(float(measured) - float(known)) <= allowed, name
assert np.all(np.abs(strokes[:5, 0] / strokes[:5, 1] - 1) < 1e-4), "equal spheres: equal strokes"
