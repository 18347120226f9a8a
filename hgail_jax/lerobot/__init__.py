"""The bridge to LeRobot, which finds it by `--env.discover_packages_path=hgail_jax.lerobot`; see `docs/lerobot.md`.

LeRobot, and with it PyTorch, is no dependency of this package: only the modules in here import it.
"""

import importlib.util


def check_installed() -> None:
    """Raises a ValueError that says how to install LeRobot, if it is missing."""
    if importlib.util.find_spec("lerobot") is None:
        raise ValueError("LeRobot is missing: pip install 'lerobot[training,evaluation]', with Python 3.12 or later")
