"""Calibrated cameras, and MuJoCo's renderer."""
