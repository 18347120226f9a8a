"""Which numbers a training has: defaults by task, learner and platform, presets, and the methods' changes to them."""
