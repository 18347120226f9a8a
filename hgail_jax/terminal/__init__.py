"""Talk with a terminal: signals, a status line."""
