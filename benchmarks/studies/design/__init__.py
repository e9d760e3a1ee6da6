"""The geometric optimization: its data, figures and page."""
