"""Runs policies that were trained on the Fetch in MJX, unchanged, in another simulator and on another robot."""
