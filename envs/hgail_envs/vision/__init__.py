"""MuJoCo's renderer."""
