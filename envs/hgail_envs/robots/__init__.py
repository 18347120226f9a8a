"""Robots: arms with a hand, each in a scene around it."""
