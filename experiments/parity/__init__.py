"""Parity of this project's Fetch with Gymnasium-Robotics'."""
