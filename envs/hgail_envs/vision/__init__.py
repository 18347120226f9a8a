"""Pictures of scenes: cameras, renderers, and how looks vary."""
