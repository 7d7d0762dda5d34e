"""One scene on several devices and processes: the numbers of one device, forward and in derivatives."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_segments import cloud
from test_sweep import ended

import jaxbeads as jb
from jaxbeads import Chain, Configuration, Load, Scene
from jaxbeads.constraint import Gears
from jaxbeads.force import Bending, Weight
from jaxbeads.mobility import RPY
from jaxbeads.shares import LEAST

BEADS = (5, 3, 5)  # two devices do not share them equally
PLANE = [0.0, 0.0, -19.0], [0.0, 0.0, 1.0]
DOMAINS = {
    "free": jb.Unbounded(),
    "wall": jb.NoSlipWall(*PLANE),
    "surface": jb.FreeSurface(*PLANE),
}


def model(devices, rigidity=30.0):
    """Fibres that settle."""
    chain, rng = Chain(1.0, BEADS), np.random.default_rng(0)
    forces = [Weight([0.0, -1.0, 0.1]), Bending(rigidity)]
    mobility = RPY(dense=False, devices=devices)
    scene = Scene(chain, 1.0, mobility, constraints=[Gears()], forces=forces)
    return scene, jb.straight(chain, rng.normal(size=(3, 3)), 7.0 * np.eye(3))


def end(devices):
    """Where they are after an implicit step."""
    scene, state = model(devices)
    return jb.rollout(scene, state, [0.0, 20.0], solver=jb.ESDIRK(substeps=1)).final.position


def off(one, other):
    """Largest difference of two trees, over their largest number."""
    pairs = list(zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))
    size = max(float(np.abs(b).max()) for _, b in pairs)
    return max(float(np.abs(a - b).max()) for a, b in pairs) / size


def moved(devices):
    """Motion of a few spheres by loads and in a strain, in each domain, and in a batch."""
    rng = np.random.default_rng(1)
    x, force, torque = rng.normal(size=(3, 7, 3))
    mobility, strain = RPY(devices=devices), jnp.asarray(np.diag([1.0, 0.5, -1.5]))
    equal, unequal = jnp.asarray(0.9), jnp.linspace(0.7, 1.4, 7)
    found = {}
    for name, domain in DOMAINS.items():
        spheres = Configuration(4 * x, unequal if name == "free" else equal, 1.0, domain=domain)
        found[name] = mobility.motion(spheres, Load(force, torque))
        found[f"{name}, strain"] = mobility.disturbance(spheres, strain)

    def batched(scale):
        return mobility.motion(Configuration(scale * x, equal, 1.0), Load(force, torque))

    found["batch"] = jax.vmap(batched)(jnp.array([3.0, 5.0]))

    # Fibres of which segments interact by a few of their beads, some of them bead by bead.
    long, load = cloud((30,) * 13)
    near = RPY(dense=False, far_error=9e-7, devices=devices)
    found["segments"] = near.product(long, load, exact=False)
    return found


def slopes(devices):
    """A rate of the fibres and its derivatives by the positions, in both modes."""
    scene, state = model(devices)
    shift = jnp.sin(jnp.arange(39.0)).reshape(13, 3)

    def height(x):
        rate = jb.dynamics.motion(0.0, jb.State(x), scene).velocity
        return jnp.sum(jnp.sin(rate + jnp.arange(13.0)[:, None]))

    value, back = jax.value_and_grad(height)(state.position)
    return value, back, jax.jvp(height, (state.position,), (shift,))[1]


def compared():
    """Differences of several devices from one."""
    found = {}
    for function, several in ((moved, (2, 4)), (slopes, (2,))):
        alone = jax.jit(lambda: function(None))()  # noqa: B023
        for devices in several:
            shared = jax.jit(lambda: function(devices))  # noqa: B023
            for name, part in shared().items() if function is moved else [("slopes", shared())]:
                expected = alone[name] if function is moved else alone
                found[f"{name}, {devices}"] = off(part, expected)
    exported = jax.export.export(jax.jit(lambda x: {"x": moved(2)["free"], "given": x}))(1.0)
    found["export"] = float(exported.nr_devices - 2)
    return found


_ELSEWHERE = """
import json, sys
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
if len(sys.argv) > 2:
    jax.distributed.initialize(sys.argv[2], 2, int(sys.argv[3]))
import numpy as np
import jaxbeads.segments
import jaxbeads.shares
jaxbeads.shares.LEAST = 0
jaxbeads.segments.LEAST, jaxbeads.segments.BEADS = 0, 15
import test_shares
several = int(sys.argv[1]) == 4
found = test_shares.compared() if several else {"end": np.asarray(test_shares.end(0)).tolist()}
print(json.dumps(found))
"""


def start(*arguments):
    """In another process."""
    command = [sys.executable, "-c", _ELSEWHERE, *map(str, arguments)]
    flags = os.environ | {"XLA_FLAGS": "--xla_backend_optimization_level=0"}
    here = Path(__file__).parent
    return subprocess.Popen(command, cwd=here, env=flags, text=True, stdout=subprocess.PIPE)


@pytest.mark.slow
def test_devices_find_what_one_finds():
    (found,) = map(json.loads, ended(start(4)))
    assert len(found) == 2 * 8 + 2
    for name, difference in found.items():
        assert difference < (1e-10 if "slopes" in name else 1e-13), name


@pytest.mark.slow
def test_processes_find_what_one_finds():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        meeting = f"127.0.0.1:{free.getsockname()[1]}"
    pair = ended(start(1, meeting, 0), start(1, meeting, 1))
    for one in map(json.loads, pair):
        assert off(jnp.asarray(one["end"]), end(None)) < 1e-12


def test_few_pairs_are_not_shared():
    # The program is that of one device.
    def text(devices):
        scene, state = model(devices)
        function = jax.jit(lambda x: jb.dynamics.motion(0.0, jb.State(x), scene).velocity)
        return function.lower(state.position).as_text()

    assert sum(BEADS) ** 2 < LEAST and text(1) == text(None) == text(0)


def test_what_is_refused(monkeypatch):
    many = len(jax.devices()) + 1
    with pytest.raises(ValueError, match="`devices` must be at least 0"):
        RPY(devices=-1)
    x = np.arange(900.0).reshape(300, 3)
    with pytest.raises(ValueError, match=f"`devices` must be at most {many - 1}, .* it is {many}"):
        RPY(devices=many).motion(Configuration(x, 1.0, 1.0), Load(jnp.asarray(x)))

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(
        ValueError, match=r"`scene\.mobility` must use devices of one process alone"
    ):
        jb.simulate(*model(0), [0.0, 1.0], progress=False)


def test_a_file_goes_on_with_other_devices(tmp_path):
    path = tmp_path / "run.h5"
    scene, state = model(None)
    options = {"solver": jb.ESDIRK(substeps=1), "progress": False}
    jb.simulate(
        scene, state, [0.0, 1.0, 2.0], file=path, chunk=1, until=lambda run: True, **options
    )
    rest = jb.resume(path, model(1)[0], **options)
    assert rest.status == "finished"
