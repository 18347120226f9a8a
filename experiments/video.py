"""Films a policy on a Fetch task."""

from pathlib import Path

import imageio
import jax
import mujoco
import numpy as np

from envs.fetch import CONTROL_PERIOD, FetchEnv
from envs.scenes import load_scene
from hgail_jax.policy import MeanPolicy

_SIZE = (480, 640)  # height, width
_HOLD = 10  # frames that the last pose of an episode stands still


def film(path: Path, env: FetchEnv, policy: MeanPolicy, episodes: int = 5, seed: int = 0) -> None:
    """Writes an mp4 of a few episodes with the target as a red ball, in real time.

    Raises:
      RuntimeError: MuJoCo cannot render here.

    """
    model = load_scene(env.scene, visual=True)
    try:
        renderer = mujoco.Renderer(model, *_SIZE)
    except Exception as error:  # whatever the GL backend raises; each has exceptions of its own
        raise RuntimeError(f"MuJoCo cannot render here, install EGL or OSMesa ({error})") from error
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    camera.distance = 1.6
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    temporary = path.with_name(f".{path.name}")
    with renderer, imageio.get_writer(temporary, format="FFMPEG", fps=round(1 / CONTROL_PERIOD)) as writer:
        for key in jax.random.split(jax.random.key(seed), episodes):
            state = reset(key)
            model.site("target").pos = np.asarray(state.info["desired_goal"])
            for time in range(env.episode_length + _HOLD):
                data.qpos[:] = np.asarray(state.pipeline_state.qpos)
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                renderer.update_scene(data, camera)
                writer.append_data(renderer.render())  # type: ignore[attr-defined]
                if time < env.episode_length:
                    state = step(state, policy(np.asarray(state.obs)))
    temporary.rename(path)
