"""Calibrated cameras: their geometry, and pictures of a scene by MuJoCo's renderer."""
