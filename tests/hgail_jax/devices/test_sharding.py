"""Training over several devices: four that XLA makes of one processor."""

import jax
import numpy as np
import pytest

from hgail_jax.devices import sharding
from hgail_jax.devices.processes import choose_mesh
from hgail_jax.devices.sharding import make_mesh, most_devices
from tests.sharded_training import assert_close, train_on_four_devices
from tests.support import four_devices


@pytest.fixture(scope="module", params=["ppo", "td3"])
def trained(request, forks):
    shared = {"task": "point", "learner": request.param, "final": request.param != "ppo"}  # two processes evaluate, too
    return train_on_four_devices(
        forks,
        alone=shared | {"groups": [[0], [1], [2], [3]], "devices": 1},
        seeds=shared | {"groups": [[0, 1, 2, 3], [3, 2, 1, 0]], "devices": 4},
    )


@pytest.mark.slow
def test_a_seed_has_the_same_bits_on_whichever_device_and_beside_whichever_others(trained):
    for leaf in trained["seeds"]:
        np.testing.assert_array_equal(leaf[:4], leaf[4:][::-1])


@pytest.mark.slow
def test_a_seed_on_each_device_agrees_with_the_seed_alone(trained):
    assert_close([leaf[:4] for leaf in trained["seeds"]], trained["alone"], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["ppo", "td3"])
def test_a_seed_over_two_devices_agrees_with_the_seed_alone(forks, learner):
    """Two seeds over four devices, so the environments of each over two."""
    shared = {"task": "point", "learner": learner}
    alone = shared | {"groups": [[0], [1]], "devices": 1}
    results = train_on_four_devices(forks, alone=alone, both=shared | {"groups": [[0, 1]], "devices": 4})
    assert_close(results["both"], results["alone"], rtol=1e-4, atol=1e-5)


REPLICAS = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import NamedSharding
from hgail_jax.devices.sharding import ALONG_SEEDS, REPLICATED, ReplicaError, check_replicas, make_mesh

mesh = make_mesh(2, 4, jax.devices())  # two seeds, each on two devices
assert tuple(mesh.shape.values()) == (2, 2)

def array(layout, parts, shape):
    placed = [jax.device_put(part, device) for part, device in zip(parts, mesh.devices.ravel(), strict=True)]
    return jax.make_array_from_single_device_arrays(shape, NamedSharding(mesh, layout), placed)

def refused(tree):
    try:
        return check_replicas(tree)
    except ReplicaError as error:
        return str(error)

def whole(*numbers):
    return array(REPLICATED, [np.float32([1.0, number]) for number in numbers], (2,))

def by_seed(*numbers):
    return array(ALONG_SEEDS, [np.float32([[number]]) for number in numbers], (2, 1))

assert refused({"weights": whole(2, 2, 2, 2)}) is None
assert refused({"weights": whole(2, 2, 2, 2 + 1e-5)}) is None  # the order of a sum
assert refused({"weights": whole(np.nan, np.nan, np.nan, np.nan)}) is None
nested = {"a": whole(2, 2, 2, 2), "b": {"weights": whole(2, 2, 2, 3)}}
assert refused(nested) == "the devices disagree: b.weights differs by 1"
assert "weights differs by nan" in refused({"weights": whole(2, 2, np.nan, 2)})
assert refused({"weights": by_seed(1, 1, 5, 5)}) is None  # seeds are not alike
assert "weights differs by 4" in refused({"weights": by_seed(1, 1, 1, 5)})
keys = [jax.random.key(number) for number in (0, 0, 0, 1)]
assert refused({"rng": array(REPLICATED, keys, ())}).startswith("the devices disagree: rng")
assert refused({"rng": array(REPLICATED, keys[:1] * 4, ())}) is None
assert refused({"weights": jnp.ones(3), "key": jax.random.key(0)}) is None  # on one device
print("done")
"""


def test_devices_that_should_hold_the_same_are_compared(forks):
    ended = forks.run(REPLICAS, four_devices())
    assert ended.stdout.strip() == "done", ended.stderr


def test_a_mesh_takes_seeds_first_and_then_environments():
    device = jax.devices()[0]
    for seeds, devices, shape in [(8, 4, (4, 1)), (6, 4, (2, 2)), (3, 4, (1, 4)), (1, 2, (1, 2))]:
        assert tuple(make_mesh(seeds, 64, [device] * devices).shape.values()) == shape
        assert most_devices(seeds, 64, devices) == devices


@pytest.mark.parametrize(
    ("version", "devices", "off"), [("0.11.2", 2, True), ("0.11.2", 1, False), ("0.12.0", 2, False)]
)
def test_shardy_is_off_for_several_devices_where_it_crashes(monkeypatch, version, devices, off):
    changed = []
    monkeypatch.setattr(sharding.jaxlib.version, "__version__", version)
    monkeypatch.setattr(jax.config, "update", lambda *change: changed.append(change))
    make_mesh(8, 64, [jax.devices()[0]] * devices)
    assert changed == [("jax_use_shardy_partitioner", False)] * off


def test_more_devices_than_there_are_are_refused():
    with pytest.raises(ValueError, match="devices is 4; JAX finds 1 device here"):
        choose_mesh(8, 64, 4)


def test_what_does_not_divide_is_refused_or_left_out():
    with pytest.raises(ValueError, match="num_envs must be a multiple of 4"):
        make_mesh(3, 6, [jax.devices()[0]] * 4)
    assert most_devices(3, 6, 4) == 3


@pytest.mark.slow
def test_environments_of_reach_over_four_devices_agree_with_one(forks):
    """Each device calls C MuJoCo on the host from a thread of its own."""
    one = {"task": "reach", "groups": [[0]], "devices": 1, "final": False}
    trained = train_on_four_devices(forks, one=one, four=one | {"devices": 4})
    assert_close(trained["four"], trained["one"], rtol=1e-2, atol=1e-3)
