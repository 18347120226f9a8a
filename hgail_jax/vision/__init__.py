"""Policies that see pictures."""
