"""Finds and loads the MJCF scenes, in a checkout and in an installed wheel alike."""

from pathlib import Path

import mujoco

_VISUAL_GROUP = 2  # of geoms that collide with nothing


def assets_directory() -> Path:
    """Returns the folder of the scenes: `hgail_envs/assets` in a wheel, `assets` of the repository in a checkout."""
    package = Path(__file__).resolve().parent
    installed = package / "assets"
    return installed if installed.is_dir() else package.parent.parent / "assets"


def load_scene(name: str, visual: bool = False) -> mujoco.MjModel:
    """Compiles the scene `assets/<name>.xml`, e.g. `"fetch/reach"`.

    Args:
      name: path of the scene below the assets folder, without its ending.
      visual: keep geoms that are only for pictures. The dynamics are the same without them, and the model is smaller.

    """
    spec = mujoco.MjSpec.from_file(str(assets_directory() / f"{name}.xml"))
    if not visual:
        for geom in [geom for geom in spec.geoms if geom.group == _VISUAL_GROUP]:
            spec.delete(geom)
    return spec.compile()
