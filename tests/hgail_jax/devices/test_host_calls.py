"""Several devices of a process, each of which calls C MuJoCo on the host from a thread of its own."""

import pytest

from tests.sharded_training import assert_close, train_on_four_devices


@pytest.mark.slow
def test_environments_of_reach_over_four_devices_agree_with_one(tmp_path):
    one = {"task": "reach", "groups": [[0]], "devices": 1, "final": False}
    trained = train_on_four_devices(tmp_path / "reach.npz", one=one, four=one | {"devices": 4})
    assert_close(trained["four"], trained["one"], rtol=1e-2, atol=1e-3)
