"""Spreads seeds, and the environments of a roll-out, over devices.

A mesh has two axes. Along `SEEDS` each device trains its own seeds and talks to no other. Along `ENVS` the devices
work on the same seeds: each steps a part of the environments, then all gather the whole trajectories and make the same
update of them. Gathering is cheap, as a trajectory is small beside the physics that made it, and so is the update.
Results depend on the devices only through the order in which matrix products sum.

Physics engines that XLA calls as a black box cannot be split by its partitioner. A program per device, by
`jax.shard_map`, leaves nothing to split.
"""

import functools
import json
import math
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jaxlib.version
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hgail_envs.validation import counted

SEEDS, ENVS = "seeds", "envs"
"""The axes of a mesh."""

ALONG_SEEDS, REPLICATED = PartitionSpec(SEEDS), PartitionSpec()
"""How arrays are laid out: their first axis, seeds, split over the devices; or whole on each device."""

_SHARDY = "JAX_USE_SHARDY_PARTITIONER"
_REPLICA_TOLERANCE = 1e-3  # by which devices may come apart through the order in which they sum


class ReplicaError(RuntimeError):
    """Devices that should hold the same numbers do not."""


def make_mesh(seeds: int, num_envs: int, devices: Sequence[jax.Device]) -> Mesh:
    """Returns a mesh over `devices`: along seeds as far as they divide, along environments for the rest.

    With jaxlib 0.11 a mesh of several devices turns JAX's partitioner Shardy off for the process, which crashes there.
    A ValueError says that the environments of a seed do not divide over the devices that are left to them.

    >>> dict(make_mesh(8, 64, jax.devices()[:1]).shape)
    {'seeds': 1, 'envs': 1}
    """
    along_seeds = math.gcd(seeds, len(devices))
    along_envs = len(devices) // along_seeds
    if num_envs % along_envs:
        raise ValueError(
            f"{counted(seeds, 'seed')} of {counted(num_envs, 'environment')} cannot be divided over"
            f" {len(devices)} devices; with {along_seeds} along the seeds, num_envs must be a multiple of {along_envs}"
        )
    if len(devices) > 1 and jaxlib.version.__version__.startswith("0.11.") and _SHARDY not in os.environ:
        jax.config.update(_SHARDY.lower(), False)
    return Mesh(np.array(devices).reshape(along_seeds, along_envs), (SEEDS, ENVS))


def most_devices(seeds: int, num_envs: int, available: int) -> int:
    """Returns the largest number of devices, of those available, that seeds and environments divide over.

    >>> most_devices(8, 64, 4), most_devices(1, 6, 4), most_devices(1, 5, 4)
    (4, 3, 1)
    """
    fitting = (count for count in range(available, 0, -1) if num_envs % (count // math.gcd(seeds, count)) == 0)
    return next(fitting)


def local_shard(array: jax.Array, axis: str | None) -> jax.Array:
    """Returns a device's own part, along the first axis, of an array; the whole where no mesh `axis` is named."""
    if axis is None:
        return array
    size = len(array) // jax.lax.axis_size(axis)
    return jax.lax.dynamic_slice_in_dim(array, jax.lax.axis_index(axis) * size, size)


def gather(tree: Any, axis: str | None, along: int) -> Any:
    """Returns the whole of arrays of which each device has its part along their axis `along`; see `local_shard`."""
    if axis is None:
        return tree
    return jax.tree.map(lambda leaf: jax.lax.all_gather(leaf, axis, axis=along, tiled=True), tree)


def shard(tree: Any, mesh: Mesh) -> Any:
    """Places arrays and PRNG keys, which every process has whole, with their first axis along `SEEDS`."""
    if mesh.size == 1:
        return tree
    sharding = NamedSharding(mesh, ALONG_SEEDS)

    def place(array: jax.Array) -> jax.Array:
        values = np.asarray(array)
        return jax.make_array_from_callback(values.shape, sharding, lambda index: values[index])

    return _on_numbers(lambda numbers: jax.tree.map(place, numbers), tree)


def replicate(tree: Any) -> Any:
    """Returns arrays and PRNG keys so that every process can read the whole of them; all processes must call it."""
    if all(leaf.is_fully_addressable for leaf in jax.tree.leaves(tree)):
        return tree
    whole = NamedSharding(jax.tree.leaves(tree)[0].sharding.mesh, REPLICATED)
    return jax.jit(lambda tree: tree, out_shardings=whole)(tree)


def check_replicas(tree: Any) -> None:
    """Raises a ReplicaError if devices that hold one part of an array differ by more than rounding.

    Devices with the same seeds make the same update of the same trajectories. Nothing else keeps them alike: a program
    per device is compiled without a check of values that vary between devices.
    """
    for path, leaf in jax.tree_util.tree_flatten_with_path(without_keys(tree))[0]:
        first: dict[str, np.ndarray] = {}
        for part in leaf.addressable_shards if len(leaf.sharding.device_set) > 1 else ():
            values = np.asarray(part.data)
            known = first.setdefault(str(part.index), values)
            if not np.allclose(values, known, rtol=_REPLICA_TOLERANCE, atol=_REPLICA_TOLERANCE, equal_nan=True):
                name = jax.tree_util.keystr(path, simple=True, separator=".")
                raise ReplicaError(f"the devices disagree: {name} differs by {np.abs(values - known).max():.3g}")


def without_keys(tree: Any) -> Any:
    """Returns a tree with PRNG keys replaced by their numbers."""
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if is_key(leaf) else leaf, tree)


def is_key(leaf: Any) -> bool:
    """Returns whether an array's elements are PRNG keys."""
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def from_first_process(tree: Any) -> Any:
    """Returns the first process's arrays and PRNG keys in every process; all must call it."""
    if jax.process_count() == 1:
        return tree
    return _on_numbers(multihost_utils.broadcast_one_to_all, tree)


def json_from_first_process(content: Any) -> Any:
    """Returns the first process's content, anything that JSON can hold, in every process; all must call it."""
    if jax.process_count() == 1:
        return content
    text = np.frombuffer(json.dumps(content).encode(), np.uint8)
    size = int(from_first_process(np.array(len(text))))
    return json.loads(bytes(from_first_process(text if is_first_process() else np.zeros(size, np.uint8))))


def _on_numbers(function: Callable[[Any], Any], tree: Any) -> Any:
    """Applies a function of trees of arrays to a tree that holds PRNG keys as well."""
    keys = jax.tree.map(is_key, tree)
    return jax.tree.map(
        lambda leaf, key: jax.random.wrap_key_data(leaf) if key else leaf, function(without_keys(tree)), keys
    )


def is_first_process() -> bool:
    """Returns whether this process, of those that `jax.distributed` joined, is the one that writes files."""
    return jax.process_index() == 0


def any_process(flag: bool) -> bool:
    """Returns whether `flag` is set in any process; all of them must call it."""
    if jax.process_count() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.array(flag))))


def jit_per_device(mesh: Mesh | None, function: Any, given: Any, returned: Any, **options: Any) -> Any:
    """Jits a function, each device of the mesh running its part; `options` are those of `jax.jit`.

    The function is of the mesh axis that environments are split along, or None, and of arrays laid out as `given`. Its
    results have an axis over seeds, and are `returned` along it or whole on each device.
    """
    if mesh is None or mesh.size == 1:
        return jax.jit(functools.partial(function, None), **options)
    axis = ENVS if mesh.shape[ENVS] > 1 else None
    place = functools.partial(jax.tree.map, functools.partial(NamedSharding, mesh))
    part = functools.partial(function, axis)
    sharded = jax.shard_map(part, mesh=mesh, in_specs=given, out_specs=ALONG_SEEDS, check_vma=False)
    return jax.jit(sharded, in_shardings=place(given), out_shardings=place(returned), **options)
