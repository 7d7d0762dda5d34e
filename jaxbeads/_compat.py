"""The one place for what is private, experimental or undocumented in jax, jaxlib, equinox and diffrax.

Each thing is looked up once, by `_borrowed`, with the reason for it and with what takes its place where
it is gone: something slower, or a service less, never another result and never an error on import.
`BORROWED` lists them; `tests/test_compat.py` has a canary for each, which says in a sentence what has
changed, and takes each away to see that the results stay. The rest of the package gets from here:

- `Tracer`, `Literal`: classes for `isinstance`.
- `named`: marks what `jax.checkpoint` shall keep by its name.
- `custom_vmap`, `HAS_RULES`: functions with a rule of their own under `vmap`.
- `working_potrf`, `CALLS_OF_KNOWN_COST`: LAPACK's Cholesky factor without copies; whether it is
  known how jaxlib shares calls of LAPACK out to threads.
- `over_devices`, `meet`: one program on several devices; processes wait for each other. `by_shares`: a
  part of a program on several devices.
- `CompileClock`: seconds spent compiling. `held_memory`: what a program holds. `forget_cache`:
  after the cache's folder was named.
- `hidden`: an array of which the compiler knows nothing.

**Tricks that rest on how XLA compiles** and are plain arithmetic stay where they are, each beside a
comment that says `XLA:`; another compiler makes them slower, not wrong. `TRICKS` names their files.

Of diffrax the documented interface of solvers and controllers is used alone (`init`, `step`,
`error_order`, `func`, `adapt_step_size`, `interpolation_cls`); a canary takes a step by it.
"""

import functools
import importlib
import math
import threading
import time
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

TRICKS = {
    "constraint/base.py": "a quotient is computed once, whoever reads it; hidden zeros are no padding",
    "coefficients.py": "a quotient is computed once, whoever reads it; the square of a reciprocal root",
    "factors.py": "a diagonal as a slice is no pass over the whole matrix",
    "near.py": "batches of one size are one program",
    "pairs.py": "products with ones are not merged with what they multiply",
    "products.py": "a product is computed once, whoever reads it; which factor is transposed",
    "run.py": "one program for some steps rounds alike, however many it is asked for",
}
"""Files of the package with tricks that rest on how XLA compiles, and what they rest on."""


class Borrowed(NamedTuple):
    """A thing that a dependency may change without notice."""

    there: bool
    reason: str
    instead: str


BORROWED: dict[str, Borrowed] = {}


def _borrowed(module: str, name: str, reason: str, instead: str) -> Any:
    """What a module holds under a name; `None` if it is gone."""
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        found = None
    BORROWED[f"{module}.{name}"] = Borrowed(found is not None, reason, instead)
    return found


# --- Kinds of values ---


class _Placeholder(type):
    def __instancecheck__(cls, value: object) -> bool:
        return isinstance(value, jax.Array) and not isinstance(value, _array_type())


@functools.cache
def _array_type() -> type:
    """The type of arrays that hold numbers."""
    return type(jax.device_put(np.zeros(())))


class _AnyPlaceholder(metaclass=_Placeholder):
    """Arrays that hold no numbers."""


class _Valued(type):
    def __instancecheck__(cls, value: object) -> bool:
        return hasattr(value, "val")


class _AnyLiteral(metaclass=_Valued):
    """Operands of a jaxpr that carry their value."""


Tracer: Any = (
    _borrowed(
        "jax.core",
        "Tracer",
        "checks of values pass over what has none yet",
        "arrays of any type but that of numbers",
    )
    or _AnyPlaceholder
)
Literal: Any = (
    _borrowed(
        "jax.extend.core",
        "Literal",
        "constants in a jaxpr depend on nothing (and have no hash)",
        "operands with a value of their own",
    )
    or _AnyLiteral
)


# --- Derivatives ---

_checkpoint_name = _borrowed(
    "jax.ad_checkpoint",
    "checkpoint_name",
    "the backward pass keeps the factors of a step, which are dear to compute again",
    "the backward pass computes whole steps again",
)


def named(values: PyTree, name: str) -> PyTree:
    """The same values under a name for `jax.checkpoint_policies.save_only_these_names`."""
    if _checkpoint_name is None:
        return values
    # Leaf by leaf: early versions take no trees.
    return jax.tree.map(lambda x: _checkpoint_name(x, name), values)


# --- Batches ---


class _WithoutRule:
    """A function that `vmap` treats as any other."""

    def __init__(self, fun: Callable[..., Any]) -> None:
        functools.update_wrapper(self, fun)
        self.fun = fun

    def __call__(self, *arguments: Any) -> Any:
        return self.fun(*arguments)

    def def_vmap(self, rule: Callable[..., Any]) -> Callable[..., Any]:
        return rule


_custom_vmap = _borrowed(
    "jax.custom_batching",
    "custom_vmap",
    "batches go to LAPACK in calls so small that no thread waits for another, and blocks are put in "
    "place without scatters",
    "on CPUs matrices are eliminated in plain arithmetic, which needs no rule, and XLA chooses the rest",
)
HAS_RULES = _custom_vmap is not None
"""Whether the rules of `custom_vmap` are heeded."""
custom_vmap: Any = _custom_vmap or _WithoutRule


# --- LAPACK ---

# From 0.9.1 on, jaxlib shares batches of LAPACK calls out to threads. In 0.10 that was measured, see
# `factors.at_once`; before there was none of it.
CALLS_OF_KNOWN_COST = jax.__version_info__ < (0, 9, 1) or (0, 10) <= jax.__version_info__ < (0, 11)
"""Whether it is known which calls of LAPACK for several matrices jaxlib shares out to threads."""

_prepare_lapack_call = _borrowed(
    "jaxlib.lapack",
    "prepare_lapack_call",
    "the Cholesky factor without a copy of the matrix before and a pass over the factor after it",
    "`lax.linalg.cholesky`",
)


def working_potrf() -> Callable[[jax.Array], tuple[jax.Array, jax.Array]] | None:
    """A function that finds, on a CPU, L of S = L L^T from the upper triangle of S, `(..., n, n)`, and
    whether S is positive; `None` where what it rests on is not what it was.

    It is what `lax.linalg.cholesky` calls, without its copy of the matrix before and its pass over the
    factor after it: these take as long as the factorisation where XLA cuts them for two threads. Above L
    there is what was there.
    """
    return _potrf if _potrf_works() else None


def _potrf(matrix: Any) -> tuple[jax.Array, jax.Array]:
    target = _prepare_lapack_call("potrf_ffi", matrix.dtype)
    result = (
        jax.ShapeDtypeStruct(matrix.shape, matrix.dtype),
        jax.ShapeDtypeStruct(matrix.shape[:-2], jnp.int32),
    )
    # The rule of `cholesky` comes first: `vmap` meets this call only in branches for other platforms.
    call = jax.ffi.ffi_call(target, result, vmap_method="broadcast_all")
    factor, failed = call(matrix, uplo=np.uint8(ord("L")))
    # Negative is no failure: it takes a matrix without rows for a mistake.
    return jnp.swapaxes(factor, -1, -2), failed <= 0


@functools.cache
def _potrf_works() -> bool:
    """Whether the call, which nobody promises, does on two small matrices what it should."""
    works = False

    def trial() -> None:
        nonlocal works
        upper = np.array([[[4.0, 2.0], [7.0, 5.0]], [[1.0, 2.0], [7.0, 1.0]]], np.float32)
        try:
            with jax.default_device(jax.local_devices(backend="cpu")[0]):
                factor, positive = jax.jit(_potrf)(upper)
            lower = np.tril(factor[0])
            works = np.allclose(lower, [[2, 0], [1, 2]]) and positive.tolist() == [True, False]
        except Exception:
            works = False

    # In a thread of its own: what is being traced in this one stays out of it.
    thread = threading.Thread(target=trial)
    thread.start()
    thread.join()
    return works


def hidden(array: jax.Array) -> jax.Array:
    """The same array, of which the compiler knows nothing."""
    return lax.optimization_barrier(array)


# --- Devices and processes ---

_shard_map = _borrowed(
    "jax",
    "shard_map",
    "one program runs on all devices at once",
    "a program for each device, started one after the other",
)
_sync = _borrowed(
    "jax.experimental.multihost_utils",
    "sync_global_devices",
    "processes that share a sweep wait for each other",
    "a sum over all devices of all processes",
)


def over_devices(function: Callable[[Any], Any], mesh: Mesh, spec: PartitionSpec) -> Any:
    """The compiled function of arrays that are spread over a row of devices, applied on each to its own
    part; results come in the order of the devices.
    """
    if _shard_map is not None:
        return jax.jit(
            _shard_map(function, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
        )
    program = jax.jit(function)

    def part(array: jax.Array, device: Any) -> jax.Array:
        return next(s.data for s in array.addressable_shards if s.device == device)

    def run(arguments: Any) -> Any:
        parts = [
            program(jax.tree.map(functools.partial(part, device=device), arguments))
            for device in mesh.devices.flat
        ]
        return jax.tree.map(lambda *x: np.concatenate([np.asarray(y) for y in x]), *parts)

    return run


def by_shares(function: Callable[[Any], Any], rows: PyTree, mesh: Mesh, spec: PartitionSpec) -> Any:
    """A function of rows of which each device of a mesh takes its share; all get the results of all."""
    if _shard_map is None:
        return function(rows)
    whole = NamedSharding(mesh, PartitionSpec())
    several = _shard_map(function, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    # On either side whole: else what comes before and after is spread, too, number by number.
    rows = lax.with_sharding_constraint(rows, whole)
    # One program: outside of any, it would be compiled line by line.
    return lax.with_sharding_constraint(jax.jit(several)(rows), whole)


def meet(name: str) -> None:
    """Wait until all processes have come here."""
    if _sync is not None:
        _sync(name)
        return
    mesh = Mesh(np.array(jax.devices()), ("devices",))
    place = NamedSharding(mesh, PartitionSpec("devices"))
    ones = jax.make_array_from_callback((mesh.size,), place, lambda _: np.ones(1, np.float32))
    jax.block_until_ready(jax.jit(jnp.sum)(ones))


# --- Compiling ---

_reset_cache = _borrowed(
    "jax.experimental.compilation_cache.compilation_cache",
    "reset_cache",
    "a cache that was asked for in vain is asked again",
    "programs are kept only if nothing was compiled before",
)
_listen = _borrowed(
    "jax.monitoring",
    "register_event_duration_secs_listener",
    "runs say how long compiling took",
    "runs say that it is not known (NaN)",
)
COMPILING = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)
"""Names of what JAX reports of its tracing, lowering and compiling."""


def held_memory(function: Any, *arguments: Any) -> int | None:
    """Bytes that the program of a function of `equinox.filter_jit` holds, its arguments and results
    included; `None` where it does not say. The next call finds it compiled.
    """
    program = getattr(function.lower(*arguments).compile(), "compiled", None)
    analysis = getattr(program, "memory_analysis", lambda: None)()
    names = "argument_size_in_bytes", "output_size_in_bytes", "temp_size_in_bytes"
    sizes = [size for name in names if (size := getattr(analysis, name, None)) is not None]
    return sum(map(int, sizes)) if len(sizes) == len(names) else None


def forget_cache() -> None:
    """Make JAX look for its compilation cache again."""
    if _reset_cache is not None:
        _reset_cache()


class CompileClock:
    """Seconds that JAX has spent tracing, lowering and compiling since the first clock was made.

    JAX says how long something took when it ends. What is traced for another thing is part of that one's
    time, and counts once.
    """

    _heard: ClassVar[set[str] | None] = None
    _stretches: ClassVar[list[tuple[float, float]]] = []
    """Of time, one after the other."""
    _total: ClassVar[float] = 0.0

    def __init__(self) -> None:
        if CompileClock._heard is None and _listen is not None:
            CompileClock._heard = set()
            _listen(CompileClock._hear)
        self.start = CompileClock._total

    @staticmethod
    def _hear(event: str, duration_secs: float, **_: str | int) -> None:
        if event in COMPILING and CompileClock._heard is not None:
            CompileClock._heard.add(event)
            stretches, end = CompileClock._stretches, time.perf_counter()
            begin = end - duration_secs
            while stretches and stretches[-1][0] >= begin:
                first, last = stretches.pop()
                CompileClock._total -= last - first
            begin = max(begin, stretches[-1][1]) if stretches else begin
            stretches.append((begin, end))
            CompileClock._total += end - begin

    def read(self) -> float:
        """Seconds since this clock was made; NaN if JAX has never said any."""
        return CompileClock._total - self.start if CompileClock._heard else math.nan
