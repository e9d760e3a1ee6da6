"""What is compared, and how it is called: presets, cells, seeds, metrics, the paper's values."""
