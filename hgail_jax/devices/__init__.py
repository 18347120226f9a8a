"""Devices, the processes that train on them together, and the layout of arrays over them."""
