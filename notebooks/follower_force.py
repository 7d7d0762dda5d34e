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
# # A filament under a follower force
#
# A filament is held at one end, and a compressive force $P$ acts on its other end, always along the
# last bond. Such a load has no potential: instead of buckling, a clamped filament starts to flap
# (flutter). It tests bending, clamps and follower forces of the Gears Model against two classical
# numbers of the slender filament with a local drag:
#
# $$ \zeta\, \partial_t y = -K_b\, y'''' - P\, y'' $$
#
# The dimensionless group is $P L^2/K_b$, with $L = 2 a N$; time is measured in $\mu L^4/K_b$. From
# an independent computation, the clamped filament flutters from $P L^2/K_b = 37.695$ on, and the
# hinged one loses its stability at $20.191$. The drag $\zeta$ sets the time scale, but not these
# thresholds, as long as it is local; hydrodynamic interactions change them.

# %%
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jaxbeads import scenes
from jaxbeads.mobility import RPY, FreeDraining

jax.config.update("jax_enable_x64", True)
viridis = plt.colormaps["viridis"]
checks = []  # rows of the table at the end: quantity, measured, reference, allowed difference

# %% [markdown]
# ## The straight state
#
# `scenes.growth_rates` linearises the motion of the chain about the straight state (by
# differentiating the program) and returns the eigenvalues: real parts are growth rates, imaginary
# parts angular frequencies. It compiles once for each number of beads and mobility; $P$ is a leaf
# of the scene.


# %%
def straight_filament(beads, mobility, hinged=False):
    """Function of P L^2/K_b: eigenvalues times mu L^4/K_b, fastest growing first."""
    case = scenes.follower_force(beads, 30.0, hinged=hinged, mobility=mobility)
    length = case.scene.chain.length[0]

    def rates(force):
        push = jnp.asarray(force / length**2)
        scene = eqx.tree_at(lambda s: s.forces[1].force, case.scene, push)
        return scenes.growth_rates(scene) * float(length) ** 4

    return rates


def bisect(function, low, high, tolerance=1e-5):
    """Where an increasing function becomes positive."""
    while high - low > tolerance:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if function(middle) > 0 else (middle, high)
    return 0.5 * (low + high)


def threshold(rates, hinged=False):
    """P L^2/K_b from which on deflections grow."""
    if not hinged:
        return bisect(lambda force: rates(force)[0].real, 10.0, 60.0)
    # One of the first two eigenvalues is the zero of rotation about the hinge; the other crosses it.
    return bisect(lambda force: np.sum(rates(force)[:2].real), 10.0, 60.0)


numbers = [10, 20, 40, 80]
clamped = {n: straight_filament(n, FreeDraining()) for n in numbers}
hinged = {n: straight_filament(n, FreeDraining(), hinged=True) for n in numbers[:3]}
coupled = {n: straight_filament(n, RPY()) for n in numbers[:3]}
flutter = {n: threshold(rates) for n, rates in clamped.items()}
turning = {n: threshold(rates, hinged=True) for n, rates in hinged.items()}
flutter_rpy = {n: threshold(rates) for n, rates in coupled.items()}
for n in numbers:
    print(f"N = {n}: clamped {flutter[n]:.3f}", end="")
    print(f", hinged {turning[n]:.3f}, clamped with RPY {flutter_rpy[n]:.3f}" if n < 80 else "")

# %% [markdown]
# **Convergence.** The thresholds of the chain approach those of the slender filament like $1/N$: of
# the length $L = 2 a N$, the part that bends is shorter by about one bead if clamped and half a
# bead if hinged (printed below). A parabola in $1/N$ through the last three thresholds (Richardson
# extrapolation) removes that.


# %%
def extrapolated(thresholds):
    """Value at 1/N = 0 of the parabola in 1/N through the last three."""
    n = np.array(list(thresholds))[-3:]
    return np.polyfit(1 / n, [thresholds[k] for k in n], 2)[-1]


limit, limit_hinged = extrapolated(flutter), extrapolated(turning)
order = np.log2((flutter[40] - 37.695) / (flutter[80] - 37.695))
checks.append(("order of convergence, clamped", order, 1.0, 0.1))
checks.append(("clamped, 1/N to 0", limit, 37.695, 0.02))
checks.append(("hinged, 1/N to 0", limit_hinged, 20.191, 0.02))
print(f"extrapolated: clamped {limit:.4f} (37.695), hinged {limit_hinged:.4f} (20.191)")
for n in numbers[:3]:
    short = [n * (1 - np.sqrt(a / b)) for a, b in ((37.695, flutter[n]), (20.191, turning[n]))]
    print(f"N = {n}: shorter by {short[0]:.2f} beads if clamped, {short[1]:.2f} if hinged")
lowered = 1 - flutter_rpy[40] / flutter[40]
print(f"hydrodynamic interactions lower the threshold by {lowered:.1%} at N = 40")

# %% [markdown]
# Hydrodynamic interactions lower the threshold. Beads drag one another along, so the drag is
# neither local nor uniform, and the thresholds of the local model need not hold.
#
# Left: the two slowest modes of the clamped filament. With growing $P$ their real rates meet and
# become a pair of complex ones, an oscillation, which then crosses to growth at a finite frequency
# (Hopf). Right: thresholds over $1/N$.

# %%
forces = np.linspace(0.0, 60.0, 61)
figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.5), layout="constrained", dpi=110)
for label, rates, colour in (("local drag", clamped, "#440154"), ("RPY", coupled, "#35b779")):
    values = np.array([rates[20](force)[:2] for force in forces])
    axes[0].plot(forces, values[:, 0].real, color=colour, label=label)
    axes[0].plot(forces, values[:, 1].real, color=colour)
    axes[1].plot(forces, np.abs(values[:, 0].imag), color=colour, label=label)
axes[0].axhline(0.0, color="0.7", linewidth=1)
axes[0].set_ylim(-60, 30)
axes[0].set_ylabel(r"growth rate $/\ (K_b/\mu L^4)$, $N = 20$")
axes[1].set_ylabel(r"angular frequency $/\ (K_b/\mu L^4)$, $N = 20$")
for ax in axes[:2]:
    ax.set_xlabel("force $P L^2/K_b$")
    ax.legend(frameon=False)
for label, found, end, colour in (
    ("clamped, local drag", flutter, 37.695, "#440154"),
    ("clamped, RPY", flutter_rpy, None, "#35b779"),
    ("hinged, local drag", turning, 20.191, "#31688e"),
):
    axes[2].plot([1 / n for n in found], list(found.values()), "o-", color=colour, label=label)
    if end is not None:
        axes[2].plot(0, end, "*", color=colour, markersize=10)
axes[2].set_xlabel("$1/N$ (stars: slender filament)")
axes[2].set_ylabel("threshold $P L^2/K_b$")
axes[2].set_ylim(0, None)
axes[2].legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# ## Flapping
#
# Beyond the threshold the deflection grows until the filament's own bending limits it, and it flaps
# for ever; below it, deflections decay. Ten beads with RPY, from 0.9 to 3 times their threshold;
# all runs share one compiled program. The start is bent slightly.

# %%
beads, span = 10, 3.0
critical = flutter_rpy[beads]
over = np.array([0.9, 1.05, 1.25, 1.5, 2.0, 3.0])  # P over its threshold
unit = (2.0 * beads) ** 4  # mu L^4/K_b
ts = np.linspace(0.0, span * unit, 601)
times = ts / unit


def flap(force):
    case = scenes.follower_force(beads, force, perturbation=0.05)
    run = case._replace(ts=ts).simulate(progress=False)
    return np.asarray(run.states.position) / (2 * beads)


shapes = [flap(factor * critical) for factor in over]
tips = [x[:, -1, 1] for x in shapes]


def crossings(tip):
    """Times over mu L^4/K_b at which the tip moves through the axis upwards."""
    k = np.flatnonzero((tip[:-1] < 0) & (tip[1:] >= 0))
    return times[k] - tip[k] * (times[k + 1] - times[k]) / (tip[k + 1] - tip[k])


late = len(times) // 2
amplitude = np.array([np.abs(tip[late:]).max() for tip in tips])
periods = [np.mean(np.diff(crossings(tip)[-4:])) for tip in tips]
frequency = 1 / np.array(periods)
for k, factor in enumerate(over):
    state = (
        f"flaps at f mu L^4/K_b = {frequency[k]:.3f}" if amplitude[k] > 0.05 else "does not flap"
    )
    print(f"P/P_c = {factor:.2f}: {state}, tip within {amplitude[k]:.2e} L in the second half")

# %% [markdown]
# Below the threshold the decay must be that of the eigenvalue. Just above it, the frequency must be
# close to the imaginary part of the eigenvalue there.

# %%
eigenvalue = coupled[beads](over[0] * critical)[0]
peaks = np.flatnonzero((tips[0][1:-1] > tips[0][:-2]) & (tips[0][1:-1] > tips[0][2:])) + 1
peaks = peaks[1:4]
decay = np.polyfit(times[peaks], np.log(tips[0][peaks]), 1)[0]
hopf = abs(coupled[beads](critical)[0].imag) / (2 * np.pi)
checks.append(("decay rate at 0.9 P_c", decay, eigenvalue.real, 0.02 * abs(eigenvalue.real)))
checks.append(("tip at 0.9 P_c, late, over L", amplitude[0], 0.0, 1e-3))
checks.append(("flapping frequency at 1.05 P_c", frequency[1], hopf, 0.05 * hopf))
checks.append(("all above flap (1: yes)", np.all(amplitude[1:] > 0.05), 1, 0))

# %%
figure, axes = plt.subplots(1, 3, figsize=(12.5, 3.6), layout="constrained", dpi=110)
for k, factor in ((0, 0.9), (1, 1.05), (4, 2.0)):
    axes[0].plot(times, tips[k], color=viridis(k / 5), label=f"{factor:g}", linewidth=1.2)
axes[0].set_xlim(0, 1.5)
axes[0].set_xlabel(r"time $t / (\mu L^4/K_b)$")
axes[0].set_ylabel("tip $y/L$")
axes[0].legend(
    frameon=False, fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1), title="$P/P_c$"
)
start, stop = crossings(tips[4])[-2:]
chosen = np.searchsorted(times, np.linspace(start, stop, 12, endpoint=False))
for k, at in enumerate(chosen):
    axes[1].plot(*shapes[4][at].T, color=viridis(k / 12), linewidth=1.6)
axes[1].set_aspect("equal", adjustable="datalim")
axes[1].set_xlabel("$x/L$")
axes[1].set_ylabel("$y/L$")
axes[1].set_title("$P/P_c = 2$", fontsize=10)
scale = plt.cm.ScalarMappable(plt.Normalize(0, 1), "viridis")
figure.colorbar(scale, ax=axes[1], label="part of a flap", shrink=0.8)
axes[2].plot(over[1:], frequency[1:], "o-", color="#440154", label="flapping")
axes[2].plot(1.0, hopf, "*", color="#35b779", markersize=11, label="eigenvalue at the threshold")
axes[2].set_xlabel("force $P/P_c$")
axes[2].set_ylabel(r"frequency $f \mu L^4/K_b$")
axes[2].set_ylim(0, None)
axes[2].legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# ## Check

# %%
print(f"{'quantity':34s} {'measured':>11s} {'reference':>10s} {'difference':>11s} {'allowed':>8s}")
for name, measured, reference, allowed in checks:
    off = abs(float(measured) - float(reference))
    print(f"{name:34s} {float(measured):11.5g} {float(reference):10.5g} {off:11.1e} {allowed:8.0e}")
for name, measured, reference, allowed in checks:
    assert abs(float(measured) - float(reference)) <= allowed, name
