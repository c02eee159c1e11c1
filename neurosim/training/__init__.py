"""From a dataset to a simulator, and how well it predicts."""
