"""What the project has measured with its library, and how; see README.md."""
