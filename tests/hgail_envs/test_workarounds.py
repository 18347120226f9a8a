"""The workarounds, and that what they work around does not come back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hgail_envs import workarounds


@pytest.mark.parametrize(
    ("version", "cores", "flags", "expected_flags", "threads"),
    [
        ((0, 11, 0), 2, "--a=1", "--a=1 --xla_cpu_use_fusion_emitters=false", "8"),
        ((0, 10, 2), 16, "", "--xla_cpu_use_fusion_emitters=false", None),
        ((0, 10, 2), 2, "--xla_cpu_use_fusion_emitters=true", "--xla_cpu_use_fusion_emitters=true", "8"),
        ((0, 11, 1), 2, "--a=1", "--a=1", None),
        ((0, 12, 0, 1), 2, "--a=1", "--a=1", None),
    ],
)
def test_xla_is_configured_only_where_the_fault_is(monkeypatch, version, cores, flags, expected_flags, threads):
    monkeypatch.setattr(workarounds.jaxlib.version, "__version_info__", version)
    monkeypatch.setattr(workarounds.os, "cpu_count", lambda: cores)
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setenv("NPROC", "")  # so that it is there again after the test
    monkeypatch.delenv("NPROC")
    workarounds.configure_xla()
    assert workarounds.os.environ["XLA_FLAGS"] == expected_flags
    assert workarounds.os.environ.get("NPROC") == threads


def test_batched_cholesky_does_not_hang():
    """Three factorisations at once, each large enough to be spread over XLA's threads."""
    matrices = jnp.eye(13) * 2.0 + jnp.zeros((2000, 13, 13))

    @jax.jit
    def factorise(matrices):
        return sum(jnp.linalg.cholesky(matrices + shift * jnp.eye(13)).sum() for shift in (0.0, 1.0, 2.0))

    expected = 2000 * 13 * sum(np.sqrt([2.0, 3.0, 4.0]))
    assert float(factorise(matrices)) == pytest.approx(expected, rel=1e-4)


def test_xla_is_configured_once_and_as_the_user_says(monkeypatch):
    monkeypatch.setattr(workarounds.jaxlib.version, "__version_info__", (0, 10, 2))
    monkeypatch.setattr(workarounds.os, "cpu_count", lambda: 2)
    monkeypatch.setenv("XLA_FLAGS", "--a=1")
    monkeypatch.setenv("NPROC", "3")
    workarounds.configure_xla()
    workarounds.configure_xla()
    assert workarounds.os.environ["XLA_FLAGS"] == "--a=1 --xla_cpu_use_fusion_emitters=false"
    assert workarounds.os.environ["NPROC"] == "3"


def test_a_stream_of_another_library_stays_registered():
    """As Warp's class does it: the wrapper of a stream takes it off the register when it is freed, the last or not."""
    registered = set()

    class Stream:
        def __init__(self, handle, owner):
            self.handle, self.owner = handle, owner
            registered.add(handle)

        def __del__(self):
            registered.discard(self.handle)

    earlier, later = Stream("theirs", owner=False), Stream("theirs", owner=False)
    del earlier
    assert not registered  # the fault: the later one is still in use
    workarounds.keep_registered(Stream)
    release = Stream.__del__
    workarounds.keep_registered(Stream)  # as the next engine does
    assert Stream.__del__ is release
    earlier, own = Stream("theirs", owner=False), Stream("own", owner=True)
    del earlier, own
    assert registered == {"theirs"}
    del later
    assert registered == {"theirs"}
