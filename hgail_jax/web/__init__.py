"""A trained policy in the browser, and a target to drag."""
