"""Finds the target's position in pictures of RGB-D cameras, instead of taking it from the simulator."""
