"""Seeds, devices and processes: what trains side by side, and on what."""
