import importlib.metadata

import hgail_jax
from hgail_jax.io.provenance import installed


def test_a_checkout_that_is_not_installed_has_its_own_version(monkeypatch):
    def version(package):
        raise importlib.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert installed("hgail-jax", "jax") == {"hgail-jax": hgail_jax.__version__, "jax": None}
