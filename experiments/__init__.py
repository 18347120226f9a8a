"""What the project has measured with its library, and how; see README.md."""

import hgail_jax  # noqa: F401  (first of all, see `hgail_jax.terminal.signals`)
