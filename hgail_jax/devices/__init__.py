"""The ground: devices, the processes that share them, and how arrays are laid out over them."""
