import importlib.metadata
from types import SimpleNamespace

import jax
import pytest

import hgail_jax
from hgail_jax.io import provenance


@pytest.mark.parametrize(("platform", "driver"), [("gpu", "580.1"), ("cpu", None)])
def test_what_ran_on_a_gpu_names_its_driver(monkeypatch, platform, driver):
    monkeypatch.setattr(provenance, "driver_version", lambda: "580.1")
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(platform=platform, device_kind="a chip")])
    assert provenance.provenance()["versions"]["driver"] == driver


def test_a_checkout_that_is_not_installed_has_its_own_version(monkeypatch):
    def version(package):
        raise importlib.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert provenance.installed("hgail-jax", "jax") == {"hgail-jax": hgail_jax.__version__, "jax": None}
