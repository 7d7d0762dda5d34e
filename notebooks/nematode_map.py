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
# # Five hundred nematodes
#
# How do speed and efficiency of a nematode depend on the stiffness of its body and on the amplitude
# of its wave? `sweep` follows 25 x 20 worms, and returns a labelled table in which every member has a
# status of its own. The worm is that of the notebook `swimmers`, $N = 12$, with the wave
# $$ \kappa_0(s, t) = -A(s)\sin(1.5\pi s/L - 2\pi f t), $$
# whose $A$ is constant over the first half of the length and falls to zero at the tail. The axes are
# its largest value $A_0 L$ and the sperm number
# $$ Sp = L\left(\frac{2\pi f\,\gamma_\perp/L}{K_b}\right)^{1/4}, $$
# with $\gamma_\perp$ the normal friction coefficient of the straight rigid worm (another definition of
# the friction moves $Sp$). The literature's worm has $2\pi f\mu L^4/K_b = 22.6$ and $A_0 L = 8.25$.

# %%
import time

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)  # as many as there are cores to be used
import equinox as eqx
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxbeads as jb
from jaxbeads import dimensionless, objectives, scenes
from jaxbeads.force import Bending
from jaxbeads.observables import rigid_resistance

plt.rcParams["figure.dpi"] = 110
BEADS, LITERATURE, SAVED = 12, 8.25, 32
nematode = scenes.nematode(BEADS)
chain, (bending,) = nematode.scene.chain, nematode.scene.forces
length = float(chain.length[0])
friction = float(rigid_resistance(nematode.state.position, chain)[1, 1])
own = float(dimensionless.sperm_number(length, 2 * np.pi, friction, bending.rigidity))
print(f"literature's worm: Sp = {own:.3f}")

# %% [markdown]
# ## One call
#
# `build` makes a member's scene and its start from its values, `measure` what is kept of its run. A
# worm starts in the shape that it prefers at that time (from straight, a stiff one would leap to it)
# and takes three periods of 32 equal implicit steps each; the third one is measured. What the shape
# changes in it says how periodic it is.


# %%
FIRST, SECOND = np.triu_indices(BEADS, 2)


def build(sperm_number, amplitude):
    """A worm of this sperm number and amplitude A_0 L."""
    rigidity = dimensionless.rigidity_from_sperm_number(sperm_number, length, 2 * np.pi, friction)
    wave = bending.intrinsic_curvature
    wave = eqx.tree_at(lambda w: w.amplitude, wave, wave.amplitude * amplitude / LITERATURE)
    scene = eqx.tree_at(lambda s: s.forces[0], nematode.scene, Bending(rigidity, wave))
    joints = chain.arclength[1:-1]
    turns = 2 * chain.radius * wave(jnp.zeros(()), joints, jnp.full(len(joints), length))
    angle = jnp.concatenate([jnp.zeros(1), jnp.cumsum(turns)])
    angle = angle - angle.mean()
    tangents = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    return scene, jb.State(jb.from_tangents(chain, tangents))


def measure(run, scene):
    """Speed V/(fL), Lighthill's efficiency, how far the third period is from periodic, over L, and the
    smallest gap between beads that are no neighbours, over a."""
    last = jax.tree.map(lambda x: x[-SAVED - 1 :], (run.ts, run.states))
    period = jb.Solution(*last, run.steps, run.code)
    position = period.states.position
    shape = position - position.mean(axis=1, keepdims=True)
    return {
        "speed": objectives.swimming_speed(period, scene, 1.0),
        "efficiency": objectives.efficiency(period, scene),
        "change": jnp.abs(shape[-1] - shape[0]).max() / length,
        "gap": jnp.min(jnp.linalg.norm(position[:, FIRST] - position[:, SECOND], axis=-1)) - 2,
    }


ts = np.linspace(0, 3, 3 * SAVED + 1)
axes = {"sperm_number": np.linspace(1.5, 6.3, 25), "amplitude": np.linspace(1.0, 10.5, 20)}
options = {"solver": jb.Rosenbrock(substeps=1)}
start = time.perf_counter()
table = jb.sweep(build, axes, ts, measure, chunk=25, progress=False, **options)
whole = time.perf_counter() - start
failed = int((table.code != 0).sum())
print(table)
print(f"{table.code.size} members in {whole:.1f} s with compiling; {failed} failed")
print("\n".join(table.attrs["failures"].splitlines()[:4]))

# %% [markdown]
# The members that failed are worms with the largest amplitudes, which coil up until beads
# pass through one another (this scene has no `Contact`). They are marked by their `code`, their
# numbers are NaN, and the others know nothing of them. The first of them are run again alone, for the
# message that names step, bead and term.

# %% [markdown]
# ## Against a loop
#
# The same function, compiled once for one member, and called by a Python loop for every tenth of them.
# The sweep's members are followed on two devices; its time here includes compiling.


# %%
def member(sperm_number, amplitude):
    """What is measured on one member."""
    scene, state = build(sperm_number, amplitude)
    return measure(jb.rollout(scene, state, ts, **options), scene)


single = jax.jit(member)
grid = np.meshgrid(*axes.values(), indexing="ij")
chosen = np.stack([g.ravel() for g in grid], axis=1)[::10]
jax.block_until_ready(single(*chosen[0]))
start = time.perf_counter()
looped = [float(single(*point)["speed"]) for point in chosen]
loop = (time.perf_counter() - start) / len(chosen)
print(f"a member takes {1e3 * loop:.1f} ms in a loop: all {table.code.size} {500 * loop:.1f} s")
print(f"the sweep took {whole:.1f} s, with compiling and the runs that explain failures")
in_table = [float(table.speed.sel(sperm_number=a, amplitude=b)) for a, b in chosen]
apart = np.nanmax(np.abs(np.array(in_table) - looped))

# %% [markdown]
# ## The map
#
# Left out of the maps are members whose beads pass through one another, which is no worm, and those
# whose shape is not yet periodic to $10^{-3} L$ in the third period, which takes soft worms longer.
# At small $Sp$ a worm takes the shape that it prefers, and the speed depends on the amplitude alone.
# Softer worms need larger amplitudes, because the fluid unbends them; up to $Sp$ of about 4 that costs
# speed but gains efficiency.

# %%
sound = (table.code == 0) & (table.change < 1e-3) & (table.gap > 0)
figure, panels = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
for ax, name, scale, label in (
    (panels[0], "speed", 1, "$V/(fL)$"),
    (panels[1], "efficiency", 100, "efficiency (%)"),
):
    values = scale * table[name].where(sound)
    image = ax.pcolormesh(axes["amplitude"], axes["sperm_number"], values, shading="nearest")
    ax.contour(axes["amplitude"], axes["sperm_number"], values, colors="w", linewidths=0.6)
    ax.plot(LITERATURE, own, "o", color="#d1495b", label="literature")
    figure.colorbar(image, ax=ax, label=label)
    ax.set(xlabel="amplitude $A_0 L$", ylabel="sperm number $Sp$")
    ax.legend(loc="upper right")
plt.show()
for name in ("speed", "efficiency"):
    top = table[name].where(sound)
    where = top.argmax(...)
    best = top.isel(where)
    print(
        f"largest {name}: {float(best):.5f} at Sp = {float(best.sperm_number):.2f}, "
        f"A_0 L = {float(best.amplitude):.2f}"
    )

# %% [markdown]
# ## Checks
#
# At small amplitude the speed is quadratic in it. The member next to the literature's is compared
# with a run of its own by another solver: equal steps of `AB3`.

# %%
small = table.speed.sel(sperm_number=own, method="nearest").values[:2]
exponent = np.log(small[1] / small[0]) / np.log(axes["amplitude"][1] / axes["amplitude"][0])
near = table.sel(sperm_number=own, amplitude=LITERATURE, method="nearest")
scene, state = build(jnp.asarray(float(near.sperm_number)), jnp.asarray(float(near.amplitude)))
explicit = jb.rollout(scene, state, ts, substeps=jb.solver.substeps_for(scene, ts))
checks = [
    ("speed at small amplitude: exponent", exponent, 2.0, 0.1),
    ("sweep and loop, largest difference of speeds", apart, 0.0, 1e-9),
    ("sweep / AB3, speed", float(near.speed / measure(explicit, scene)["speed"]), 1.0, 3e-3),
]
print(f"{'quantity':46s} {'measured':>12s} {'reference':>10s} {'allowed':>9s}")
for name, measured, reference, allowed in checks:
    print(f"{name:46s} {float(measured):12.6g} {float(reference):10.6g} {allowed:9.0e}")
for name, measured, reference, allowed in checks:
    assert abs(float(measured) - float(reference)) <= allowed, name
bad = table.code != 0
assert 0 < failed < 25 and not (bad & (table.amplitude < 9)).any()
assert np.array_equal(np.isnan(table.speed), bad)
