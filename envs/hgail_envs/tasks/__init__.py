"""The Fetch arm and its tasks."""
