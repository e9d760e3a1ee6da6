"""How fast things are: ratios, measured side by side."""
