"""Localisation of the target in pictures of RGB-D cameras, in place of the simulator's position."""
