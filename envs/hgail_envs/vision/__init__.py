"""What a camera sees: its geometry, and pictures of a scene by MuJoCo's renderer."""
