"""How far this project's Fetch moves as Gymnasium-Robotics' does, and as its own scenes do in C MuJoCo."""
