"""Warp's renderer: the poses and the order of its pictures, and against MuJoCo's own renderer.

A GPU is not needed: Warp compiles its kernels for a CPU, too.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hgail_envs
from hgail_envs.vision.look import LOOKS
from hgail_envs.vision.opengl import OpenGLRenderer
from hgail_envs.vision.pictures import Pictures

pytest.importorskip("warp", reason="needs warp-lang")
pytestmark = pytest.mark.slow
SCENES, SIZE = 8, 64


@pytest.fixture(scope="module", params=["push", "stack"])
def starts(request):
    """A task and starts of its episodes, `[SCENES, nq]`."""
    env = hgail_envs.make(request.param, worlds=SCENES)
    return env, jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), SCENES)).pipeline_state.qpos


def test_pictures_are_those_of_mujocos_renderer(starts, rendering):
    env, qpos = starts
    pictures = Pictures(env, ["front", "side"], SIZE, "warp")
    draws = jnp.zeros((SCENES, pictures.draws))
    seen = np.asarray(jax.jit(pictures)(qpos, draws), int)
    own = OpenGLRenderer(pictures.model, [0, 1], SIZE, LOOKS["plain"])
    (expected,) = own._on_host(np.asarray(qpos), np.asarray(draws))
    difference = np.abs(seen - expected.reshape(seen.shape)).max(axis=-1)
    assert np.mean(difference > 40) < 0.04  # edges, which only one of them smooths
    assert np.median(difference) < 8


def test_distances_are_those_of_mujocos_renderer(starts, rendering):
    env, qpos = starts
    pictures = Pictures(env, ["front", "side", "wrist"], SIZE, "warp", "cameras", kind="depth")
    draws = jax.random.uniform(jax.random.key(1), (SCENES, pictures.draws), minval=-1.0)
    seen = np.asarray(jax.jit(pictures)(qpos, draws), int)
    assert seen.shape == (SCENES, 3, SIZE, SIZE, 1) and (seen == 255).any() and (seen < 32).any()
    own = OpenGLRenderer(pictures.model, [0, 1, 2], SIZE, LOOKS["cameras"], depth=True)
    (expected,) = own._on_host(np.asarray(qpos), np.asarray(draws))
    difference = np.abs(seen - expected.reshape(seen.shape))
    assert np.mean(difference > 1) < 0.02  # round shapes, which only one of them draws as such
    assert np.mean(difference == 0) > 0.95


def test_a_light_casts_shadows_where_it_is_to(starts):
    env, qpos = starts
    seen = {}
    for look in ("varied", "shadowless"):
        pictures = Pictures(env, ["front", "side"], SIZE, "warp", look)
        draws = jnp.zeros((SCENES, pictures.draws))
        seen[look] = np.asarray(jax.jit(pictures)(qpos, draws), int)
    fell = seen["shadowless"].sum(axis=-1) - seen["varied"].sum(axis=-1)
    assert (fell >= -1).all()
    assert (fell > 60).mean(axis=(1, 2, 3)).min() > 0.02


def test_the_marker_is_where_mujocos_renderer_has_it(starts, rendering):
    env, qpos = starts
    pictures = Pictures(env, ["front", "side"], SIZE, "warp", target="seen")
    if not pictures.marker:
        assert env.shows_goal
        return
    goals = jax.random.uniform(jax.random.key(2), (SCENES, 3)) * 0.3 + jnp.array([1.15, 0.6, 0.45])
    qpos, draws = jnp.concatenate([qpos, goals], axis=1), jnp.zeros((SCENES, pictures.draws))
    seen = np.asarray(jax.jit(pictures)(qpos, draws), int)
    own = OpenGLRenderer(pictures.model, [0, 1], SIZE, LOOKS["plain"])
    expected = own._on_host(np.asarray(qpos), np.asarray(draws))[0].reshape(seen.shape).astype(int)
    for one, other in zip(seen.reshape(-1, SIZE, SIZE, 3), expected.reshape(-1, SIZE, SIZE, 3), strict=True):
        places = [np.argwhere((picture[..., 0] - picture[..., 1:].max(axis=-1)) > 60) for picture in (one, other)]
        if min(map(len, places)) >= 4:  # else the hand hides it
            np.testing.assert_allclose(places[0].mean(axis=0), places[1].mean(axis=0), atol=2.5)
    assert (seen[..., 0] - seen[..., 1:].max(axis=-1) > 60).sum(axis=(1, 2, 3)).min() >= 4


def test_each_scene_comes_back_in_its_place_and_time(starts):
    env, qpos = starts
    pictures = Pictures(env, ["side", "front"], SIZE, "warp", look="varied")
    draws = jax.random.uniform(jax.random.key(1), (SCENES, pictures.draws), minval=-1.0)
    flat = np.asarray(jax.jit(pictures)(qpos, draws))
    assert len({picture.tobytes() for picture in flat}) == SCENES

    def in_time(qpos, draws):
        return jax.lax.scan(lambda _, scene: (None, pictures(*scene)), None, (qpos[:, None], draws[:, None]))[1]

    nested = jax.jit(jax.vmap(in_time))(qpos.reshape(2, 4, -1), draws.reshape(2, 4, -1))
    np.testing.assert_array_equal(np.asarray(nested).reshape(flat.shape), flat)
