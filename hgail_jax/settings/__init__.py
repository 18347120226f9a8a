"""Sizes and hyperparameters of a training: per task (`defaults`), shared (`presets`) and per method (`methods`)."""
